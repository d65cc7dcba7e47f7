"""What apps are granted: the product's parts what they declare, other apps that without what commands."""

from importlib import import_module

import pytest

from due.drivers.redis_rights import Rights, acl_rules, covers
from sdnator.app_catalogue import ENFORCERS, OURS
from sdnator.config.up_settings import GrantPlan
from sdnator.rights.granting import DANGEROUS, declared, granted, is_dangerous

_MODULES = {
    "coordinator": "coordinator.service",
    "dashboard": "sdnator.dashboard.service",
    **{name: f"apps.{name}.service" for name in OURS},
    **{name: f"apps.enforcers.{name}.service" for name in ENFORCERS},
}


@pytest.mark.parametrize("name", _MODULES)
def test_a_part_of_the_product_is_granted_what_it_declares(name):
    """And hardly more: its own segment of keys, and what its settings may ask for."""
    module, rights = import_module(_MODULES[name]), granted(name).rights
    wanted = [
        *module.INTERESTS,
        *getattr(module, "SYN_INTERESTS", ()),
        *getattr(module, "SHARDED_INTERESTS", ()),
        *getattr(module, "ENFORCER_INTERESTS", ()),
    ]
    for interest in wanted:
        assert any(covers(one, interest.key) for one in rights.observe), interest.key
    for capability in module.CAPABILITIES:
        assert any(covers(one, capability.key) for one in rights.publish), capability.key
    assert all(name in one or "sonata" in one or name == "coordinator" for one in rights.publish)


@pytest.mark.parametrize("family", DANGEROUS)
@pytest.mark.parametrize("key", ["network.{}.mine.s1", "network.*.mine.s1", "network.{}.**", "**"])
def test_what_commands_is_granted_only_by_name(family, key):
    pattern = key.format(family)
    found = declared("mine", (pattern, "network.anomaly.mine.score"), ("network.block.**",))
    assert found.rights.publish == ("network.anomaly.mine.score",)
    assert found.rights.observe == ("network.block.**",)
    assert found.withheld == (pattern,)
    named = declared(
        "mine", (pattern,), (), [GrantPlan(app="mine", publish=(pattern,)), GrantPlan(app="other")]
    )
    assert (named.rights.publish, named.withheld) == ((pattern,), ())


@pytest.mark.parametrize(
    ("key", "dangerous"),
    [
        ("network.anomaly.mine.**", False),
        ("network.evidence.mine.*", False),
        ("network.confirmation.mine.*", False),
        ("house.climate.*", False),
        ("house.**", False),
        ("network.anomaly.kitsune.score", True),
        ("network.confirmation.p4runtime_ctrl.s1", True),
        ("due.assignment.firewall", True),
        ("due.**", True),
        ("*.block.firewall.ipv4", True),
    ],
)
def test_keys_that_another_part_writes_are_dangerous(key, dangerous):
    assert is_dangerous(key, "mine") is dangerous


def test_declared_keys_can_be_taken_away():
    plan = GrantPlan(app="mine", publish=("a.b",), declared=False)
    found = declared("mine", ("network.anomaly.mine.x",), ("c.d",), [plan])
    assert (found.rights.publish, found.rights.observe) == (("a.b",), ())


def test_reading_from_the_archive_is_a_grant_of_its_own():
    """What an app declares to observe says nothing about what was."""
    assert declared("mine", (), ("a.**",)).rights.read == ()
    plan = GrantPlan(app="mine", read=("a.b",))
    assert declared("mine", (), ("a.**",), [plan, GrantPlan(app="other", read=("c",))]).rights.read == (
        "a.b",
    )
    assert "a.b" not in " ".join(acl_rules(Rights(app="mine", read=("a.b",)))), "nothing for Data Updates"
    with pytest.raises(ValueError, match=r"read=a\.\.b"):
        GrantPlan(app="mine", read=("a..b",))


def test_rules_name_every_key_of_an_app_and_none_of_another():
    text = " ".join(acl_rules(Rights(app="mine", publish=("a.b.**",), observe=("c.*.d",))))
    for name in (
        "&due:a.b",
        "&due:a.b.*",
        "~due:stream:a.b.*",
        "&due:c.*.d",
        "&due:due.assignment.mine",
        "&due:due.heartbeat.mine",
        "%R~due:stream:c.*.d",
        "~due:readers:c.*.d",
        "~due:work:mine:*",
        "~due:lease:mine:*",
    ):
        assert f" {name} " in text or f" {name})" in text
    assert "allchannels" not in text
    assert "+@all" not in text
    assert " ~due:stream:c" not in text, "who observes writes nothing on a stream"
