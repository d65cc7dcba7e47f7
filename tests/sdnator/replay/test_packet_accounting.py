"""The bookkeeping of packets in flight."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sdnator.replay.packet_accounting import COPIED, FORWARDED, PacketAccounting, PacketState


def scores(*arrivals: int, trained: bool = False):
    index = np.array(arrivals, np.uint64)
    return index, np.full(len(index), 0.5), np.full(len(index), trained)


def test_verdicts_decide_what_makes_no_score():
    """Neither copied nor forwarded is dropped, forwarded only is not copied, copied waits for a score."""
    flight = PacketAccounting(3)
    flight.send(3)
    flight.judge(bytes([0, FORWARDED, COPIED | FORWARDED]))
    assert flight.state.tolist() == [PacketState.DROPPED, PacketState.NOT_COPIED, PacketState.IN_FLIGHT]
    assert flight.in_flight == 1
    flight.scored(*scores(2))
    assert (flight.in_flight, flight.state[2]) == (0, PacketState.SCORED)


def test_score_may_overtake_its_verdict():
    """Scores and verdicts come by different ways; a packet counts once."""
    flight = PacketAccounting(1)
    flight.send(1)
    flight.scored(*scores(0, trained=True))
    flight.judge(bytes([COPIED]))
    assert (flight.in_flight, flight.state[0]) == (0, PacketState.TRAIN)


def test_foreign_arrival_number_is_refused():
    """A score for a packet that the capture does not have means two feeders at one switch."""
    flight = PacketAccounting(2)
    with pytest.raises(ValueError, match="packet 7 of 2"):
        flight.scored(*scores(7))


def test_by_digest_a_packet_without_a_copy_waits_for_its_score():
    flight = PacketAccounting(3, by_digest=True)
    flight.send(3)
    flight.judge(bytes([FORWARDED, 0, FORWARDED]))
    assert (flight.in_flight, flight.state[1]) == (2, PacketState.DROPPED)
    flight.scored(*scores(0, 2))
    assert (flight.in_flight, flight.count(PacketState.SCORED)) == (0, 2)


def test_without_verdicts_order_tells_what_was_dropped():
    """A packet overtaken by the score of a later one made no copy; numbers begin anywhere."""
    flight = PacketAccounting(5, verdicts=False)
    flight.send(5)
    flight.scored(*scores(100, 103))
    assert flight.state.tolist()[:4] == [2, PacketState.DROPPED, PacketState.DROPPED, 2]
    assert flight.in_flight == 1
    flight.settle()
    assert (flight.in_flight, flight.state[4]) == (0, PacketState.DROPPED)


def test_drop_counters_decide_only_where_they_make_up_all_in_flight():
    """One packet of three may still be on its way to Kitsune: two counted drops settle nothing yet."""
    flight = PacketAccounting(4, verdicts=False)
    flight.send(4)
    flight.scored(*scores(0))
    flight.settle_counted(2)
    assert flight.in_flight == 3
    flight.settle_counted(3)
    assert (flight.in_flight, flight.count(PacketState.DROPPED)) == (0, 3)


def test_late_score_corrects_a_settled_packet():
    """Settling is a guess after silence; a score that comes after all is the truth."""
    flight = PacketAccounting(2, verdicts=False)
    flight.send(2)
    flight.scored(*scores(0))
    flight.settle()
    flight.scored(*scores(1))
    assert (flight.in_flight, flight.state[1]) == (0, PacketState.SCORED)


@given(st.lists(st.sampled_from([0, COPIED, FORWARDED, COPIED | FORWARDED]), max_size=60), st.randoms())
def test_every_packet_is_counted_once(verdicts, random):
    """Whatever the order of verdicts and scores, in = scored + dropped + not copied."""
    flight = PacketAccounting(len(verdicts))
    flight.send(len(verdicts))
    copied = [i for i, verdict in enumerate(verdicts) if verdict & COPIED]
    events = [("verdict", v) for v in verdicts] + [("score", i) for i in copied]
    # Verdicts keep their order among themselves, as do scores; how they interleave is chance.
    keyed = sorted(((random.random(), kind) for kind, _ in events))
    queues = {"verdict": iter(verdicts), "score": iter(copied)}
    for _, kind in keyed:
        value = next(queues[kind])
        flight.judge(bytes([value])) if kind == "verdict" else flight.scored(*scores(value))
    assert flight.in_flight == 0
    counted = [
        flight.count(state) for state in (PacketState.SCORED, PacketState.DROPPED, PacketState.NOT_COPIED)
    ]
    assert sum(counted) == len(verdicts)
    assert counted[0] == len(copied)
