"""What people tell the firewall is carried out or refused with a reason."""

import pytest

from apps.firewall.evidence.known_sources import KnownSources
from apps.firewall.policy.block_lifecycle import SECOND, BlockLifecycle
from apps.firewall.policy.false_alarms import FalseAlarms
from apps.firewall.policy.instructions import Desk, target_in
from apps.firewall.policy.rate_limits import RateLimits
from apps.firewall.policy.rules import AllowList, Rules
from apps.firewall.syn.flood_evidence import Suspicion
from apps.firewall.syn.services import TcpService
from apps.firewall.syn.syn_defence import SynDefence
from apps.firewall.syn.syn_policy import SynRules
from apps.messages import Decision, Exhibit, Instruction, Target
from tests.apps.firewall.syn.test_recent_syns import batch
from tests.apps.firewall.syn.test_syn_defence import decided

WEB = TcpService("10.0.0.1", 80)
NOW = 1_000 * SECOND
SAID = Exhibit(key="network.instruction.operator.firewall", timestamp=1, summary="said")


def desk(*allowed: str) -> Desk:
    lifecycle = BlockLifecycle(Rules())
    syn = SynDefence(strict_rules(), (), lifecycle, AllowList(), KnownSources(10))
    return Desk(lifecycle, syn, RateLimits(Rules()), allowed, FalseAlarms(90))


def strict_rules() -> SynRules:
    return SynRules()


def tell(made: Desk, verb: str, subject: str = "", **fields):
    instruction = Instruction.from_value({"id": "i1", "verb": verb, "subject": subject, **fields})
    return made.carry_out(instruction, SAID, NOW)


def test_block_by_hand_says_who_wanted_it():
    """On all switches, as long as told, with the instruction as evidence."""
    (decision,), answer = tell(desk(), "block", "192.0.2.66", reason="ticket 4711", seconds=60)
    assert (decision.action, decision.switch, decision.expires) == ("block", "*", NOW + 60 * SECOND)
    assert "ticket 4711" in decision.reason
    assert decision.evidence == (SAID,)
    assert answer.done
    assert decision.id in answer.text


@pytest.mark.parametrize(
    ("allowed", "subject", "why"),
    [
        ("192.0.2.0/24", "192.0.2.66", "allow-list"),
        ("02:00:00:00:00:01", "02:00:00:00:00:01", "allow-list"),
        ("10.0.0.1", "web", "not an IP address"),
    ],
)
def test_refused_with_a_reason(allowed, subject, why):
    """The allow-list always wins, and what is no address is named."""
    decisions, answer = tell(desk(allowed), "block", subject)
    assert (decisions, answer.done) == ([], False)
    assert why in answer.text


@pytest.mark.parametrize("which", ["g1", WEB.address])
def test_unblock_releases_a_guard_that_a_flood_led_to(which):
    """By id or address; guards of the settings stay, and what is none is said to be so."""
    made = desk()
    guard = Decision(
        id="g1", action="protect", switch="*", target=WEB.target, reason="", event_time=1, expires=2 * NOW
    )
    made._syn.restore([guard])
    (lifted,), answer = tell(made, "unblock", which)
    assert (lifted.action, lifted.target, answer.text) == ("unprotect", WEB.target, "1 lifted")
    assert made._syn.guarded == []
    assert not tell(made, "unblock", which)[1].done


def test_unblock_by_id_and_by_address():
    """What is not blocked is said to be so."""
    made = desk()
    (first,), _ = tell(made, "block", "192.0.2.1")
    tell(made, "block", "192.0.2.2")
    assert not tell(made, "block", "192.0.2.1")[1].done
    assert [each.id for each in tell(made, "unblock", first.id)[0]] == [first.id]
    assert [each.action for each in tell(made, "unblock", "192.0.2.2")[0]] == ["unblock"]
    assert not tell(made, "unblock", "192.0.2.2")[1].done


def test_allowing_lifts_blocks_that_touch_it():
    """Also retroactively; and a restart knows it from what was said."""
    made = desk()
    tell(made, "block", "192.0.2.1")
    (lifted,), _ = tell(made, "allow", "192.0.2.0/24")
    assert (lifted.action, lifted.target.address) == ("unblock", "192.0.2.1")
    again = desk("10.0.0.1")
    again.take_up([Instruction(id="a", verb="allow", subject="192.0.2.0/24")])
    assert again.entries == ("10.0.0.1", "192.0.2.0/24")
    assert not tell(again, "block", "192.0.2.1")[1].done
    assert tell(again, "disallow", "192.0.2.0/24")[1].done
    assert tell(again, "block", "192.0.2.1")[1].done
    assert not tell(again, "disallow", "192.0.2.0/24")[1].done


def test_allowing_an_address_lifts_the_block_of_its_hosts_mac():
    """A host with one address is blocked by MAC; that of another host stays blocked."""
    made = desk()
    for last, host in ((5, "10.0.0.5"), (6, "10.0.0.6"), (7, "")):
        target = Target(kind="mac", address=f"02:00:00:00:00:0{last}", port=3)
        made._lifecycle.open("s1", target, "scan", (), NOW, host=host)
    (lifted,), answer = tell(made, "allow", "10.0.0.5")
    assert (lifted.action, lifted.target.address) == ("unblock", "02:00:00:00:00:05")
    assert "1 block lifted" in answer.text


def test_wrong_allow_entry_changes_nothing():
    """It is named, and the list stays."""
    made = desk("10.0.0.1")
    _, answer = tell(made, "allow", "10.0.0.300")
    assert not answer.done
    assert "'10.0.0.300'" in answer.text
    assert made.entries == ("10.0.0.1",)


def test_panic_lifts_blocks_and_guards():
    """Everything that was not in the settings."""
    lifecycle = BlockLifecycle(Rules())
    syn = SynDefence(strict_rules(), (), lifecycle, AllowList(), KnownSources(10))
    syn.recent.add(batch(*[(1, f"77.0.{n // 256}.{n % 256}", WEB.address, WEB.port) for n in range(600)]))
    decided(syn, syn.suspect(Suspicion(WEB.address, SAID, NOW, 0)))
    made = Desk(lifecycle, syn, RateLimits(Rules()), (), FalseAlarms(90))
    tell(made, "block", "192.0.2.1")
    decisions, answer = tell(made, "panic")
    assert sorted(each.action for each in decisions) == ["unblock", "unprotect"]
    assert answer.done
    assert (len(lifecycle.blocks), syn.guarded) == (0, [])


def test_targets():
    """Addresses get their one spelling; a MAC is blocked on any port."""
    assert target_in("2001:DB8::0:1") == Target(kind="ip", address="2001:db8::1")
    assert target_in("02:00:00:00:00:AA") == Target(kind="mac", address="02:00:00:00:00:aa")
    assert target_in("02:00:00:00:00:AA@3") == Target(kind="mac", address="02:00:00:00:00:aa", port=3)
    assert target_in("192.0.2.7/24") == Target(kind="ip", address="192.0.2.0/24")
    assert target_in("192.0.2.7/32") == Target(kind="ip", address="192.0.2.7")
    for wrong in ("02:00:00:00:00:AA@x", "192.0.2.7@3", "192.0.2.0/33"):
        with pytest.raises(ValueError, match="not an IP address"):
            target_in(wrong)
    assert target_in("02:00:00:00:00:AA@65535").port == 65_535
    for wrong in ("02:00:00:00:00:AA@65536", "02:00:00:00:00:AA@99999999999999999999"):
        with pytest.raises(ValueError, match="65,535"):
            target_in(wrong)
