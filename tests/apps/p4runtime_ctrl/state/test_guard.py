"""A protected service gets its entries and meters in an order in which nothing it needs is missing."""

import pytest

from apps.messages import Target
from apps.p4runtime_ctrl.errors import EntryError
from apps.p4runtime_ctrl.southbound.values import number
from apps.p4runtime_ctrl.state.desired_state import DELETE, INSERT, MODIFY
from apps.p4runtime_ctrl.state.guard import (
    GuardSettings,
    Rate,
    protection,
    release,
    secrets_entry,
    service_of,
)
from sdnator.testing.product_program import program


def described(changes):
    return [(change.kind, program().describe(change.entry)) for change in changes]


def test_protection_and_release():
    settings = GuardSettings(hold_s=2.5, cookies=False, unchallenged=Rate(rate=7, burst=9))
    changes = protection(program(), ("2001:db8::1", 443), 5, settings)
    assert described(changes) == [
        (MODIFY, "ingress.guard_accept_meter[5]"),
        (MODIFY, "ingress.guard_reflect_meter[5]"),
        (INSERT, "ingress.protected_hosts[is_ipv4=0,dst=2001:db8::1]"),
        (INSERT, "ingress.protect[is_ipv4=0,dst=2001:db8::1,dport=443]"),
    ]
    entry = changes[-1].entry
    assert [number(param.value) for param in entry.action.action.params] == [5, 2_500_000, 0]
    meter = entry.meter_config
    assert (meter.cir, meter.cburst, meter.pir, meter.pburst) == (7, 9, 7, 9)
    assert described(release(program(), ("2001:db8::1", 443), last_of_host=True)) == [
        (DELETE, "ingress.protect[is_ipv4=0,dst=2001:db8::1,dport=443]"),
        (DELETE, "ingress.protected_hosts[is_ipv4=0,dst=2001:db8::1]"),
    ]
    assert len(release(program(), ("2001:db8::1", 443), last_of_host=False)) == 1


def test_secrets():
    entry = secrets_entry(program(), 1, (1, 2, 3, 4))
    assert entry.is_default_action
    assert [number(param.value) for param in entry.action.action.params] == [1, 1, 2, 3, 4]


@pytest.mark.parametrize(
    "target",
    [
        Target(kind="ip", address="10.0.0.1"),
        Target(kind="mac", address="02:00:00:00:00:01", port=1),
        Target(kind="ip", address="nowhere", port=80),
    ],
)
def test_what_is_no_service(target):
    with pytest.raises(EntryError, match="protect"):
        service_of(target)
