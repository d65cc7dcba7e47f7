"""Guards, watches and what they lead to."""

from apps.firewall.evidence.known_sources import KnownSources
from apps.firewall.policy.block_lifecycle import SECOND, BlockLifecycle
from apps.firewall.policy.rules import AllowList, Rules
from apps.firewall.syn.flood_evidence import Suspicion
from apps.firewall.syn.recent_syns import RecentSyns
from apps.firewall.syn.services import TcpService
from apps.firewall.syn.syn_defence import (
    REFUSED_S,
    SERVICES_LEARNT,
    SOURCES_SAMPLED,
    SynDefence,
    Watch,
)
from apps.firewall.syn.syn_policy import SynRules
from apps.messages import Confirmation, Decision, Exhibit
from tests.apps.firewall.syn.test_recent_syns import batch

WEB = TcpService("10.0.0.1", 80)
FLOOD = Exhibit(key="network.traffic_query.sonata.syn_flood", timestamp=1, summary="120 half-open")
NOW = 1_000 * SECOND


def defence(*guards: TcpService, rules: Rules | None = None, allow: tuple[str, ...] = ()) -> SynDefence:
    lifecycle = BlockLifecycle(rules or Rules())
    return SynDefence(SynRules(), guards, lifecycle, AllowList.parse(allow), KnownSources(10))


def decided(made: SynDefence, watch: Watch) -> list[Decision]:
    """What a look that is sure leads to."""
    return [each for finding in made.findings(watch, 10.0) for each in made.decide(finding, {})]


def flood(made: SynDefence, sources: int, each: int, now: int = NOW) -> list[Decision]:
    rows = [
        (1, f"10.2.{n % sources // 256}.{n % sources % 256}", WEB.address, WEB.port)
        for n in range(sources * each)
    ]
    made.recent = RecentSyns(len(rows))
    made.recent.add(batch(*rows))
    return decided(made, made.suspect(Suspicion(WEB.address, FLOOD, now, 0)))


def test_services_of_the_settings_are_guarded_on_every_switch_that_comes():
    """Before any attack, without end, and with a reason."""
    made = defence(WEB)
    for switch in ("s1", "s2"):
        (decision,) = made.arm(switch, NOW)
        assert (decision.action, decision.switch, decision.expires) == ("protect", switch, 0)
        assert decision.target == WEB.target
        assert "settings" in decision.reason


def test_repeating_sources_are_blocked_with_evidence():
    """One source that sends everything is blocked on all switches."""
    (decision,) = flood(defence(), 1, 600)
    assert (decision.action, decision.switch, decision.target.address) == ("block", "*", "10.2.0.0")
    assert decision.evidence == (FLOOD,)


def test_who_knocks_at_a_server_that_is_gone_is_not_blocked():
    """Nothing is half-open there; the guard says so, and the block follows when the service is heard of."""
    silent = {WEB}
    made = SynDefence(
        SynRules(), (), BlockLifecycle(Rules()), AllowList.parse(()), KnownSources(10), silent.__contains__
    )
    (decision,) = flood(made, 1, 600)
    assert decision.action == "protect"
    assert decision.reason.startswith("600 unfinished SYNs from 1 sources")
    assert "these are blocked once it answers anybody" in decision.reason
    made.handshake("10.9.9.9", WEB, NOW)
    assert [each.action for each in flood(made, 1, 600, NOW + SECOND)] == ["block"]


def test_blocked_source_is_not_blocked_twice():
    """A second look at the same flood adds nothing."""
    made = defence()
    flood(made, 1, 600)
    assert flood(made, 1, 600, NOW + SECOND) == []


def test_spoofed_flood_leads_to_a_guard_that_a_later_switch_gets_too():
    """Six hundred sources with one SYN each cannot be blocked."""
    made = defence()
    (decision,) = flood(made, 600, 1)
    assert (decision.action, decision.target) == ("protect", WEB.target)
    assert made.guarded == [WEB]
    assert [each.switch for each in made.arm("s9", NOW)] == ["s9"]


def test_flood_whose_syns_pass_elsewhere_leads_to_a_guard_of_known_services():
    """The query saw it, the stream of SYNs did not: services known from handshakes are guarded."""
    made = defence()
    made.handshake("10.3.0.1", WEB, NOW)
    made.handshake("10.3.0.1", TcpService("10.0.0.9", 22), NOW)
    (decision,) = decided(made, made.suspect(Suspicion(WEB.address, FLOOD, NOW, 0)))
    assert (decision.action, decision.target) == ("protect", WEB.target)
    assert FLOOD.summary in decision.reason


def test_guard_ends_an_hour_after_the_last_flood():
    """It is not lifted while the attack goes on."""
    made = defence()
    flood(made, 600, 1)
    made.suspect(Suspicion(WEB.address, FLOOD, NOW + 1800 * SECOND, 0))
    assert made.due(NOW + 3600 * SECOND) == []
    (lifted,) = made.due(NOW + 5400 * SECOND)
    assert lifted.action == "unprotect"
    assert made.guarded == []


def said_of(decision: Decision, state: str) -> Confirmation:
    return Confirmation.from_value(
        {"id": decision.id, "switch": "s1", "state": state, "action": "protect", "event_time": NOW}
    )


def test_guard_that_the_switch_refused_is_set_again_while_the_flood_goes_on():
    """Not at once, since the switch may refuse it again: it would come and go with each look."""
    made = defence()
    (decision,) = flood(made, 600, 1)
    made.confirm(said_of(decision, "failed"), NOW, stands=False)
    assert made.guarded == []
    assert flood(made, 600, 1, NOW + SECOND) == []
    (again,) = flood(made, 600, 1, NOW + REFUSED_S * SECOND)
    assert again.id != decision.id
    assert made.guarded == [WEB]


def test_guard_that_one_of_two_switches_has_stays():
    """Whichever of them answers first; and it ends when its time is over."""
    for answers in (("failed", "installed"), ("installed", "failed")):
        made = defence()
        (decision,) = flood(made, 600, 1)
        for number, state in enumerate(answers):
            made.confirm(said_of(decision, state), NOW, stands="installed" in answers[: number + 1])
        assert made.guarded == [WEB]
        assert [each.id for each in made.due(decision.expires)] == [decision.id]


def test_guard_ends_on_every_switch_that_was_told_of_it():
    """The archive has a copy for each switch that connected since."""
    made, restarted = defence(), defence()
    decisions = [*flood(made, 600, 1), *made.arm("s1", NOW), *made.arm("s2", NOW)]
    restarted.restore(decisions)
    (ended,) = restarted.due(decisions[0].expires)
    assert (ended.action, ended.id, ended.switch) == ("unprotect", decisions[0].id, "*")


def test_guarded_service_is_not_guarded_again():
    """What the settings protect needs no second decision, and never lapses."""
    made = defence(WEB)
    assert flood(made, 600, 1) == []
    assert made.due(NOW * 100) == []


def test_flash_crowd_is_no_flood():
    """SYNs whose handshakes are finished do not count."""
    made = defence()
    sources = [f"10.3.0.{number % 250}" for number in range(500)]
    made.recent.add(batch(*[(1, source, WEB.address, WEB.port) for source in sources]))
    for source in sources:
        made.handshake(source, WEB, NOW)
    assert decided(made, made.suspect(Suspicion(WEB.address, FLOOD, NOW, 0))) == []


def test_known_source_that_floods_is_spared():
    """Its address may be forged: the service is guarded instead."""
    made = defence()
    made.handshake("10.2.0.0", WEB, NOW)
    (decision,) = flood(made, 1, 600)
    assert (decision.action, decision.target) == ("protect", WEB.target)


def test_caps_hold_for_floods():
    """Past them nothing is blocked, and it is counted."""
    made = defence(rules=Rules(max_decisions_per_minute=10))
    assert len(flood(made, 100, 6)) == 10
    assert made._lifecycle.refused == 90


def test_dry_run_marks_guards_and_blocks():
    """Decide and say, but change nothing."""
    made = defence(rules=Rules(dry_run=True))
    assert all(decision.dry_run for decision in flood(made, 2, 300))
    assert all(decision.dry_run for decision in defence(WEB, rules=Rules(dry_run=True)).arm("s1", NOW))


def test_state_is_bounded():
    """Any number of forged sources and of services does not fill the memory."""
    watch = Watch(Suspicion(WEB.address, FLOOD, NOW, 0), NOW)
    made = defence()
    for number in range(20_000):
        watch.add(80, str(number))
        made.handshake("10.3.0.1", TcpService("10.0.0.1", number), NOW)
    assert len(watch.syns) == SOURCES_SAMPLED
    assert len(made.services) == SERVICES_LEARNT
