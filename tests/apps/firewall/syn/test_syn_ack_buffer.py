"""Half-open connections are reset after the rule is in force, when they had time, and nobody innocent is."""

import numpy as np
import pytest

from apps.firewall.syn.services import TcpService
from apps.firewall.syn.syn_ack_buffer import Answers, SynAckBuffer, Wanted, packet_outs
from due import RecordBatch
from tests.apps.firewall.rows import records, syn_ack

WEB = TcpService("10.0.0.1", 80)
SERVICE = Wanted(WEB)


def answers(*clients: str, at: float = 0.0, rows: int = 1000) -> Answers:
    kept = Answers(rows)
    kept.add(records([syn_ack(client, 4000, WEB.address, 7) for client in clients]), at)
    return kept


def resets(kept: Answers, limit: int = 100) -> SynAckBuffer:
    made = SynAckBuffer(kept, after_s=1.0, limit=limit)
    made.plan("d1", SERVICE, 0.5)
    return made


def due(made: SynAckBuffer, now: float, *spared: str, switches: tuple[str, ...] = ("s1",)) -> list[int]:
    found = made.due(now, switches, lambda: lambda address: address in spared)
    return [each.client & 0xFF for each in found]


def test_a_service_that_answers_nobody_is_told_from_one_that_does():
    """The port counts, too."""
    kept = answers("10.2.0.1")
    assert not kept.lacks(WEB)
    assert kept.lacks(TcpService("10.0.0.9", 80))
    assert kept.lacks(TcpService(WEB.address, 443))


def test_nothing_before_the_switch_confirms_nor_before_their_time():
    """A reset backlog would be filled again; a client may still answer."""
    made = resets(answers("10.2.0.5"))
    assert due(made, 5.0) == []
    made.confirm("d1", "pending", 0.5)
    made.confirm("d1", "installed", 0.6)
    assert due(made, 0.9) == []
    assert due(made, 1.1) == [5]
    assert due(made, 2.7) == []
    assert "reset or spared" in made.notes.pop().text
    assert (made.sent, made.waited_out) == (1, 0)


def test_answers_until_the_confirmation_are_looked_at_too():
    """The flood goes on until the rule is there; nothing is reset twice."""
    kept = answers("10.2.0.5")
    made = resets(kept)
    made.confirm("d1", "installed", 0.9)
    kept.add(
        records([syn_ack("10.2.0.6", 1, WEB.address, 7), syn_ack("10.2.0.5", 4000, WEB.address, 7)]), 0.8
    )
    assert due(made, 1.6) == [5]
    assert due(made, 1.65) == []
    assert due(made, 1.9) == [6]


def test_answers_whose_copies_come_after_the_confirmation_are_looked_at_too():
    """A backlog is full within milliseconds of a flood: what is not reset keeps all clients out."""
    kept = answers("10.2.0.5", at=0.55)
    kept.add(records([syn_ack("10.2.0.6", 1, WEB.address, 7)]), 0.62)  # of the same block
    made = resets(kept)
    made.confirm("d1", "installed", 0.6)
    kept.add(records([syn_ack("10.2.0.7", 1, WEB.address, 7)]), 0.8)
    assert due(made, 1.6) == []
    assert due(made, 1.85) == [5, 6, 7]
    assert due(made, 2.7) == []
    assert "3 were examined" in made.notes.pop().text


def test_known_allowed_and_finished_clients_are_spared():
    """They are counted."""
    made = resets(answers("10.2.0.5", "10.2.0.6"))
    made.confirm("d1", "exists", 0.6)
    assert due(made, 2.0, "10.2.0.5") == [6]
    assert made.spared == 1


def test_what_another_decision_had_reset_is_not_reset_again():
    """The guard came first, then the block of the source; nothing had to be waited out."""
    made = resets(answers("10.2.0.5"))
    made.plan("d2", Wanted(source="10.2.0.5"), 0.5)
    made.confirm("d1", "installed", 0.6)
    made.confirm("d2", "installed", 0.6)
    assert due(made, 2.7) == [5]
    assert (made.sent, made.waited_out, len(made.notes)) == (1, 0, 1)


@pytest.mark.parametrize(
    ("kept", "switches", "why"),
    [
        (Answers(10), ("s1",), "no SYN-ACK was seen"),
        (answers("10.2.0.5"), ("s1", "s2"), "2 switches"),
    ],
)
def test_where_it_cannot_it_says_so(kept, switches, why):
    """The server's own time-out is waited out."""
    made = resets(kept)
    made.confirm("d1", "installed", 0.6)
    assert due(made, 9.0, switches=switches) == []
    assert made.waited_out == 1
    assert why in made.notes[0].text
    assert "own time-out" in made.notes[0].text


def test_missing_columns_are_named():
    """Records of another make."""
    kept = Answers(10)
    kept.add(RecordBatch({"time_us": np.zeros(1, np.int64)}), 0.0)
    made = resets(kept)
    made.confirm("d1", "installed", 0.6)
    due(made, 9.0)
    assert "tcp_ack" in made.notes[0].text


def test_refused_and_unconfirmed_decisions_reset_nothing():
    """Without the rule a reset helps nobody."""
    made = resets(answers("10.2.0.5"))
    made.confirm("d1", "failed", 0.6)
    made.plan("d2", SERVICE, 0.5)
    assert due(made, 99.0) == []
    assert [note.decision for note in made.notes] == ["d2"]


def test_only_what_is_wanted():
    """One service since a time; or one source."""
    kept = Answers(10)
    rows = [
        syn_ack("10.2.0.5", 1, WEB.address, 7, time_us=5),
        syn_ack("10.2.0.6", 1, "10.0.0.9", 7, time_us=9),
    ]
    kept.add(records(rows), 0.0)
    wanted = [SERVICE, Wanted(WEB, since=6000), Wanted(source="10.2.0.6"), Wanted(source="::a02:6")]
    assert [[each.client & 0xFF for each in kept.find(some, 1.0)] for some in wanted] == [[5], [], [6], []]


def test_bounded():
    """In answers kept and in resets of one decision."""
    kept = Answers(100)
    for number in range(300):
        kept.add(records([syn_ack(f"10.2.0.{n}", number, WEB.address, 7) for n in range(10)]), 0.0)
    assert 100 <= len(kept) < 140
    made = resets(kept, limit=50)
    made.confirm("d1", "installed", 0.6)
    assert len(due(made, 2.0)) == 50
    assert made.left_out == 50
    assert resets(kept, limit=0).due(99.0, ("s1",), lambda: bool) == []


def test_frames_travel_behind_each_other():
    """Lengths cut them apart again."""
    kept = answers("10.2.0.5", "10.2.0.6")
    kept.add(records([syn_ack("2001:db8::5", 1, "2001:db8::1", 7)]), 0.0)
    halves = [*kept.find(SERVICE, 1.0), *kept.find(Wanted(TcpService("2001:db8::1", 80)), 1.0)]
    (value,) = packet_outs(halves)
    assert value["length"].tolist() == [54, 54, 74]
    assert len(value["frames"]) == sum(value["length"].tolist())
    assert value["port"].tolist() == [3, 3, 3]
    assert [len(each["port"]) for each in packet_outs(halves * 200)] == [512, 88]
