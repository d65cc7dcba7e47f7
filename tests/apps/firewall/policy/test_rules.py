"""The blocking rules, case by case."""

import pytest

from apps.firewall.policy.rules import AllowList, Rules, judge, narrowest_target
from apps.messages import Sender, Target
from tests.apps.firewall.alerts import alert

RULES = Rules()
NOBODY = AllowList()


@pytest.mark.parametrize(
    ("changes", "blocked"),
    [
        ({"anomalous_seconds": 1}, False),
        ({"anomalous_seconds": 4}, False),
        ({"anomalous_seconds": 5}, True),
        ({"anomalous_seconds": 2, "rate": 400.0, "training_rate": 20.0}, True),
        ({"anomalous_seconds": 1, "rate": 400.0, "training_rate": 20.0}, False),
        ({"anomalous_seconds": 2, "rate": 399.0, "training_rate": 20.0}, False),
        ({"anomalous_seconds": 2, "rate": 400.0, "training_rate": 0.0}, False),
        ({"anomalous_seconds": 10, "role": "gateway"}, False),
        ({"anomalous_seconds": 10, "role": "dns"}, False),
        ({"anomalous_seconds": 10, "role": "multicast"}, False),
    ],
)
def test_block_needs_enough_anomalous_seconds_of_an_ordinary_host(changes, blocked):
    """Five of ten, or two at twenty times the training rate; never a router or server."""
    assert (judge(alert(**changes), RULES, NOBODY).target is not None) == blocked


def test_one_anomalous_second_is_enough_on_probation():
    """A sender whose block was lifted does not get five more seconds."""
    assert judge(alert(anomalous_seconds=1), RULES, NOBODY, on_probation=True).target is not None


@pytest.mark.parametrize("entry", ["192.168.2.108", "192.168.2.0/24", "5C:CF:7F:05:F2:C6"])
def test_allow_list_always_wins(entry):
    """Neither the address, its prefix nor the MAC of an allowed sender is blocked."""
    verdict = judge(alert(anomalous_seconds=10), RULES, AllowList.parse((entry,)))
    assert verdict.target is None
    assert "allow-list" in verdict.reason


def test_wrong_allow_entry_is_named():
    """The operator is told which entry is wrong."""
    with pytest.raises(ValueError, match=r"'192\.168\.2\.300'"):
        AllowList.parse(("10.0.0.1", "192.168.2.300"))


def test_station_with_one_address_is_blocked_by_mac_and_port():
    """This stops its ARP and spoofed frames too."""
    assert narrowest_target(alert().sender, 1) == Target(kind="mac", address="5c:cf:7f:05:f2:c6", port=1)


def test_station_with_many_addresses_is_blocked_by_address():
    """Behind a router's MAC stand innocent hosts."""
    assert narrowest_target(alert().sender, 7) == Target(kind="ip", address="192.168.2.108")


def test_frames_without_address_from_a_shared_mac_block_nobody():
    """There is nothing narrow enough to block."""
    sender = Sender(switch="s1", port=1, mac="4c:09:d4:c6:12:7b")
    verdict = judge(alert(sender=sender, mac_addresses=7), RULES, NOBODY)
    assert verdict.target is None
    assert "7 addresses" in verdict.reason
