"""The service end to end without a server: what comes in, what goes out, what it says of itself."""

import json
import threading
import time

import pytest

from apps.evidence import TrainingState
from apps.firewall.policy.rules import Rules
from apps.firewall.syn.syn_policy import SynRules
from apps.messages import Answer, Instruction, TableCommand
from due import Item
from tests.apps.firewall.alerts import alert
from tests.apps.firewall.desk import ALERT, NOW, SYN_ACKS, SYNS, Desk, FakeEngine
from tests.apps.firewall.rows import records, syn_ack
from tests.apps.firewall.syn.test_recent_syns import batch

VICTIM = "10.0.0.1"
QUICK = SynRules(grace_ms=0, patience_ms=0, reset_after_ms=0)
LONG_MS = 3_600_000
INSTRUCTION = "network.instruction.operator.firewall"
INSTRUCTIONS = "network.instruction.*.firewall"


class Clock:
    """The service's wall clock, put forward by hand: however slow the machine is, no time passes by itself."""

    time_ns = staticmethod(time.time_ns)

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr("apps.firewall.service.time", made)
    return made


def flood(desk: Desk, *sources: str, each: int = 1) -> None:
    rows = [(NOW // 1000, source, VICTIM, 80) for source in sources for _ in range(each)]
    desk.hand(SYNS, batch(*rows))


def spoofed(number: int = 600) -> list[str]:
    return [f"77.0.{n // 256}.{n % 256}" for n in range(number)]


def commands(desk: Desk, table: str) -> list[str]:
    found = [TableCommand.from_value(each) for each in desk.written("network.p4_command.firewall")]
    return [update.kind for each in found for update in each.updates if update.table == table]


def test_spoofed_flood_guards_then_resets_what_is_half_open():
    """The whole way: surge, guard, confirmation, packet-outs."""
    desk = Desk(syn=QUICK)
    flood(desk, *spoofed())
    answers = [syn_ack(source, 1000, VICTIM, 8, time_us=NOW // 1000) for source in spoofed(5)]
    desk.hand(SYN_ACKS, records(answers))
    assert desk.guarded == [VICTIM]
    assert desk.blocked == []
    assert desk.written("network.packet_out") == []
    desk.confirm(desk.decisions[0])
    desk.tick_until(lambda: desk.written("network.packet_out.firewall.s1"))
    (value,) = desk.written("network.packet_out.firewall.s1")
    assert value["port"].tolist() == [3] * 5
    assert desk.service.health()["resets"] == 5


def test_a_flood_that_began_just_before_its_window_leaves_nothing_half_open():
    """A backlog is full within milliseconds: the window that reports the flood may hold none of its connections."""
    desk = Desk(syn=QUICK)
    flood(desk, *spoofed())
    window_us = NOW // 1000 // 200_000 * 200_000
    answers = [syn_ack(source, 1000, VICTIM, 8, time_us=window_us - 1000) for source in spoofed(5)]
    desk.hand(SYN_ACKS, records(answers))
    desk.confirm(desk.decisions[0])
    desk.tick_until(lambda: desk.written("network.packet_out.firewall.s1"))
    assert desk.service.health()["resets"] == 5


def test_one_source_is_guarded_against_first_and_blocked_when_sure(clock):
    """A guard harms nobody; the block comes with the second look, if the victim is seen to answer."""
    desk = Desk(syn=SynRules(grace_ms=0, patience_ms=LONG_MS))
    desk.hand(SYN_ACKS, records([syn_ack("77.0.0.1", 1, VICTIM, 8, time_us=NOW // 1000)]))
    flood(desk, "77.0.0.1", each=600)
    assert (desk.guarded, desk.blocked) == ([VICTIM], [])
    assert "unless they finish" in desk.decisions[0].reason
    clock.now += LONG_MS / 1000
    desk.service.tick()
    assert desk.blocked == ["77.0.0.1"]


def test_flood_is_looked_at_in_time_though_neither_tick_nor_syn_comes(clock):
    desk = Desk(syn=SynRules(grace_ms=20))
    with desk.service._lock:  # the look comes later, in another thread
        flood(desk, *spoofed())
        assert desk.guarded == []
        clock.now += 0.02
    for _ in range(6000):
        if desk.guarded:
            break
        time.sleep(0.01)
    assert desk.guarded == [VICTIM]


def test_slow_handshakes_are_no_flood(clock):
    """A far crowd behind one address: guarded for a moment, not blocked, once its handshakes are finished."""
    desk = Desk(syn=SynRules(grace_ms=0, patience_ms=LONG_MS))
    flood(desk, "77.0.0.1", each=600)
    for number in range(600):
        value = {"source": "77.0.0.1", "service": VICTIM, "port": 80, "at": NOW + number}
        desk.hand("network.handshake.sonata.tcp", value)
    clock.now += LONG_MS / 1000
    desk.service.tick()
    assert desk.blocked == []


def test_archive_that_hangs_holds_no_decision_up():
    """Decisions go on with a note, and the archive is not asked again at once."""
    engine = FakeEngine()
    desk = Desk(engine=engine, archive_patience_s=0.05, detect=False)
    engine.archive_hangs = threading.Event()
    try:
        desk.hand(ALERT, alert(anomalous_seconds=5).to_value())
        assert len(desk.blocked) == 1
        assert "history unknown" in desk.decisions[0].reason
        assert desk.service.health()["archive_away"] == 1
    finally:
        engine.archive_hangs.set()


def test_archive_that_is_away_from_the_start():
    """Cold and without history."""
    engine = FakeEngine()
    engine.archive_away = True
    desk = Desk(engine=engine, syn=QUICK)
    flood(desk, *spoofed())
    assert desk.guarded == [VICTIM]
    assert "nobody is known" in desk.decisions[0].reason


def test_guard_that_the_switch_refused_is_not_shown_as_in_force():
    desk = Desk(syn=QUICK)
    flood(desk, *spoofed())
    desk.confirm(desk.decisions[0], "failed")
    assert desk.service.health()["guarded"] == []


def test_switch_gets_everything_again_after_controller_or_switch_began_anew():
    """Allowed entries, guards, prefix blocks, known sources; not at every word of the same controller."""
    desk = Desk(guard=("10.0.0.1:80",), rules=Rules(allow=("10.0.0.9",)))
    said = Instruction(id="a", verb="block", subject="192.0.2.0/24", reason="test").to_value()
    desk.hand(INSTRUCTION, said, pattern=INSTRUCTIONS)
    desk.hand(
        "network.handshake.sonata.tcp", {"source": "10.3.0.1", "service": VICTIM, "port": 80, "at": NOW}
    )
    desk.service.tick()
    before = len(desk.engine.written)
    desk.switch()
    assert len(desk.engine.written) == before
    for change in ({"instance": "i2"}, {"primary": False, "instance": "i2"}, {"instance": "i2"}):
        desk.engine.written.clear()
        desk.switch(**change)
        if change.get("primary", True):
            tables = [commands(desk, f"ingress.{name}") for name in ("allow", "block", "known_sources")]
            assert tables == [["insert"]] * 3
            assert desk.guarded == ["10.0.0.1"]


def test_prefix_block_by_hand_lives_and_dies_as_a_command():
    """The command has the decision's id, so that confirmations and counters find it."""
    desk = Desk()
    said = Instruction(id="a", verb="block", subject="192.0.2.128/24", reason="test").to_value()
    desk.hand(INSTRUCTION, said, pattern=INSTRUCTIONS)
    (made,) = desk.decisions
    (command,) = desk.written("network.p4_command.firewall")
    assert (made.target.address, command["id"]) == ("192.0.2.0/24", made.id)
    desk.hand(INSTRUCTION, Instruction(id="b", verb="panic").to_value(), pattern=INSTRUCTIONS)
    assert commands(desk, "ingress.block") == ["insert", "delete"]


@pytest.mark.parametrize("clock_s", [1, -3600])
def test_panic_in_the_archive_is_carried_out(monkeypatch, clock_s):
    """Once: said while Data Updates were away, be it after the wall clock was set back by an hour."""
    monkeypatch.setattr("apps.firewall.instruction_handler.ARCHIVED_WORD_S", 0.0)
    desk = Desk()
    desk.hand(
        INSTRUCTION, Instruction(id="a", verb="block", subject="192.0.2.1").to_value(), pattern=INSTRUCTIONS
    )
    desk.service.tick()
    later = time.time_ns() + clock_s * 10**9
    panic = Instruction(id="p", verb="panic").to_value()
    desk.engine.archived.append(Item(INSTRUCTION, panic, later, later, "operator", "o1", 1))
    desk.tick_until(lambda: len(desk.decisions) > 1)
    assert [each.action for each in desk.decisions] == ["block", "unblock"]
    desk.service.tick()
    assert len(desk.decisions) == 2


def test_instruction_that_is_sent_again_is_not_carried_out_again():
    """Data Updates send again what nobody has acknowledged; the archive has the answers of an earlier run."""
    engine = FakeEngine()
    first = Answer(id="a", done=True, text="blocked").to_value()
    engine.archived.append(Item("network.answer.firewall.operator", first, 1, 1, "firewall", "f1", 1))
    desk = Desk(engine=engine)
    for name, address in (("a", "192.0.2.1"), ("b", "192.0.2.2"), ("b", "192.0.2.3")):
        said = Instruction(id=name, verb="block", subject=address).to_value()
        desk.hand(INSTRUCTION, said, pattern=INSTRUCTIONS)
    assert desk.blocked == ["192.0.2.2"]
    answers = desk.written("network.answer.firewall.operator")
    assert [each["id"] for each in answers] == ["a", "b", "b"], "the first answer may be lost"
    assert answers[0] == first
    assert answers[1] == answers[2]


def test_an_instruction_that_an_earlier_run_did_not_answer_is_carried_out():
    """It was acknowledged as written, and may have been lost with Data Updates and the firewall."""
    engine, now = FakeEngine(), time.time_ns()
    for number, (name, at) in enumerate((("old", 1), ("answered", now), ("new", now)), start=1):
        said = Instruction(id=name, verb="block", subject=f"192.0.2.{number}").to_value()
        engine.archived.append(Item(INSTRUCTION, said, at, at, "operator", "o1", number))
    first = Answer(id="answered", done=True, text="blocked").to_value()
    engine.archived.append(Item("network.answer.firewall.operator", first, now, now, "firewall", "f1", 1))
    desk = Desk(engine=engine)
    assert desk.blocked == ["192.0.2.3"]
    answers = desk.written("network.answer.firewall.operator")
    assert [(each["id"], each["done"]) for each in answers] == [("answered", True), ("new", True)]
    desk.hand(INSTRUCTION, said, pattern=INSTRUCTIONS)
    assert desk.blocked == ["192.0.2.3"], "it may come by Data Updates, too"


def test_an_instruction_whose_block_stands_since_before_a_restart_is_done():
    """The firewall was killed between its decision and its answer."""
    engine, now = FakeEngine(), time.time_ns()
    said = Instruction(id="a", verb="block", subject="192.0.2.1")
    engine.archived.append(Item(INSTRUCTION, said.to_value(), now, now, "operator", "o1", 1))
    decision = Desk(engine=engine).decisions[0]
    archived = Item("network.block.firewall.ipv4", decision.to_value(), now, now, "firewall", "f1", 1)
    second = FakeEngine()
    second.archived = [*engine.archived, archived]
    desk = Desk(engine=second)
    answers = desk.written("network.answer.firewall.operator")
    assert [(each["id"], each["done"]) for each in answers] == [("a", True)]
    assert decision.id in answers[0]["text"]
    assert not desk.blocked


def test_an_instruction_is_answered_as_done_when_its_decision_is_stored():
    """A firewall that is killed while the disk is full forgets what is in its memory only."""
    engine = FakeEngine()
    desk = Desk(engine=engine)
    for name, engine.disk_full in (("a", True), ("b", False)):
        said = Instruction(id=name, verb="block", subject=f"192.0.2.{len(desk.blocked)}").to_value()
        desk.hand(INSTRUCTION, said, pattern=INSTRUCTIONS)
    answers = desk.written("network.answer.firewall.operator")
    assert [(each["id"], each["done"]) for each in answers] == [("a", False), ("b", True)]
    assert "in force, but not stored" in answers[0]["text"]
    assert len(desk.blocked) == 2
    assert desk.service.health()["answers_unstored"] == 1


def test_refused_allow_entry_in_the_archive_does_not_stop_the_start():
    """Instructions are archived before anybody checks them."""
    engine = FakeEngine()
    wrong = Instruction(id="a", verb="allow", subject="10.0.0.300").to_value()
    right = Instruction(id="b", verb="allow", subject="10.0.0.3").to_value()
    engine.archived += [
        Item(INSTRUCTION, value, n, n, "operator", "o1", n)
        for n, value in enumerate((wrong, {"x": 1}, right))
    ]
    assert Desk(engine=engine).service.health()["allowed"] == 1


def test_caps_stop_and_shout():
    """Event, EVE line, log and health; once a minute, not once a flood."""
    desk = Desk(rules=Rules(max_blocks=1), detect=False)
    for number in range(5):
        sender = {"switch": "s1", "port": 1, "mac": f"02:00:00:00:00:0{number}", "ip": f"10.0.0.{number}"}
        value = alert(anomalous_seconds=5).to_value() | {"sender": sender}
        desk.hand(ALERT, value)
    assert len(desk.blocked) == 1
    (shout,) = [text for text in desk.events if "STOPPED" in text]
    assert "max_blocks" in shout
    health = desk.service.health()
    assert (health["refused_by_cap"], health["blocking_stopped"]) == (4, 1)


def test_known_hosts_are_not_blocked_in_numbers():
    """A quarter of them, at most."""
    desk = Desk()
    for number in range(8):
        value = {"source": f"10.0.0.{number}", "service": VICTIM, "port": 80, "at": NOW}
        desk.hand("network.handshake.sonata.tcp", value)
    for number in range(8):
        sender = {"switch": "s1", "port": 1, "mac": f"02:00:00:00:00:0{number}", "ip": f"10.0.0.{number}"}
        desk.hand(ALERT, alert(anomalous_seconds=5).to_value() | {"sender": sender})
    assert len(desk.blocked) == 2
    assert any("max_known_share" in text for text in desk.events)


def test_hosts_of_training_count_though_few_have_finished_a_handshake():
    """A quarter of two hosts would let the second attacker of a network of twelve go on."""
    desk = Desk()
    state = TrainingState(
        packets=9, wanted=9, done=True, seconds=3_600.0, senders=500, hosts=12, event_time=NOW
    )
    desk.hand("network.training.kitsune", state.to_value(), pattern="network.training.*")
    for number in range(4):
        value = {"source": f"10.0.0.{number}", "service": VICTIM, "port": 80, "at": NOW}
        desk.hand("network.handshake.sonata.tcp", value)
        sender = {"switch": "s1", "port": 1, "mac": f"02:00:00:00:00:0{number}", "ip": f"10.0.0.{number}"}
        desk.hand(ALERT, alert(anomalous_seconds=5).to_value() | {"sender": sender})
    assert len(desk.blocked) == 3
    assert any("3 of 12 known hosts" in text for text in desk.events)


def test_one_direction_is_told_once():
    """Nobody can become known then."""
    desk = Desk(syn=QUICK)
    for _ in range(3):
        flood(desk, *spoofed())
        desk.service.tick()
    assert len([text for text in desk.events if "only one direction" in text]) == 1


def test_events_go_to_the_file_and_health_is_numbers(tmp_path):
    """Incidents and notices; the file is whole when the service has stopped."""
    eve = tmp_path / "eve.json"
    desk = Desk(eve_file=str(eve), detect=False)
    desk.hand(ALERT, alert(anomalous_seconds=5).to_value())
    desk.service.stop()
    events = [json.loads(line) for line in eve.read_text().splitlines()]
    assert [event["alert"]["metadata"]["event"] for event in events] == [["opened"], ["decided"]]
    assert len({event["flow_id"] for event in events}) == 1
    health = desk.service.health()
    assert health["sinks"] == [{"name": "eve_file", "delivered": 2, "lost": 0}]
    assert health["events_lost"] == 0


def test_dry_run_touches_nothing():
    """No entries, no resets."""
    desk = Desk(syn=QUICK, rules=Rules(dry_run=True))
    flood(desk, *spoofed())
    desk.hand(SYN_ACKS, records([syn_ack("77.0.0.1", 1, VICTIM, 8, time_us=NOW // 1000)]))
    assert all(each.dry_run for each in desk.decisions)
    desk.confirm(desk.decisions[0])
    desk.service.tick()
    assert desk.written("network.packet_out") == []
