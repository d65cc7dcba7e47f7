"""What is remembered of decisions in many places, and for how long."""

from typing import Any, cast

from msgspec import structs

from apps.firewall.enforcement.declared_enforcers import DeclaredEnforcers
from apps.messages import Confirmation, State
from due import Engine
from tests.apps.firewall.desk import FakeEngine

SWITCH = "p4runtime_ctrl"
HOST = "nftables"


def enforcers(*names: str) -> DeclaredEnforcers:
    return DeclaredEnforcers(cast(Engine, FakeEngine()), names)


def said(decision: str, state: State, place: str = "s1") -> Confirmation:
    return Confirmation(id=decision, switch=place, state=state, action="block", event_time=1)


def test_a_decision_that_is_over_is_forgotten() -> None:
    """Also one whose drop counter comes once more, because another thread had read it before."""
    known = enforcers(SWITCH)
    for number in range(5_000):
        name = f"d{number}"
        assert known.confirmed(SWITCH, said(name, "installed"))
        assert known.count(name, SWITCH, "s1", 7) == 7
        assert known.confirmed(SWITCH, said(name, "removed"))
        assert known.count(name, SWITCH, "s1", 9) == 9
    assert (len(known), known.in_force("d4999")) == (0, ())


def test_it_is_over_when_nobody_carries_it_out_any_more() -> None:
    known = enforcers(SWITCH, HOST)
    known.confirmed(SWITCH, said("d1", "installed"))
    known.confirmed(HOST, said("d1", "installed", "gateway"))
    assert not known.confirmed(SWITCH, said("d1", "removed"))
    assert known.in_force("d1") == ("nftables gateway",)
    assert known.confirmed(HOST, said("d1", "removed", "gateway"))
    assert "d1" not in known


def test_commands_are_not_followed_unless_they_carry_out_a_decision() -> None:
    """The switch confirms every known source and every query under the same key; prefixes are blocked by command."""
    known = enforcers(SWITCH)
    command = structs.replace(said("firewall-1", "installed"), action="insert")
    prefix = structs.replace(said("d1", "installed"), action="insert")
    assert not known.follows(command, {"d1"})
    assert known.follows(prefix, {"d1"})
    known.confirmed(SWITCH, prefix)
    assert known.follows(structs.replace(prefix, action="delete", state="removed"), set())
    assert known.follows(said("d2", "installed"), set())


def test_one_that_is_set_again_is_followed_again() -> None:
    known = enforcers(SWITCH)
    for state in ("installed", "removed", "installed"):
        known.confirmed(SWITCH, said("d1", cast(Any, state)))
    assert known.in_force("d1") == ("p4runtime_ctrl s1",)
    assert known.count("d1", SWITCH, "s1", 3) + known.count("d1", SWITCH, "s2", 4) == 3 + 7
