"""Where a replay need not be held back: what a dry run saw, compared with a slow twin that asks packet by packet."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.messages import Decision, Target
from sdnator.replay.quiet_stretches import (
    AFTER_NS,
    BEFORE_NS,
    COUNTED_NS,
    HOLD_NS,
    QuietStretches,
    Sign,
    laps,
    sign_of,
)

SECOND = 1_000_000_000
MINUTE = np.arange(60) * SECOND
"""A packet a second."""
TIMES = st.lists(st.integers(0, 120 * SECOND), max_size=40)


def quiet(found: QuietStretches, packets: int) -> list[int]:
    """The packets that may be sent freely, walked as the feeder does."""
    free, at = [], 0
    while at < packets:
        end = found.end(at)
        free += range(at, end)
        at = max(end, at + 1)
    return free


def signs(*times: int, senders: tuple[str, ...] = ()) -> list[Sign]:
    return [Sign(at, senders) for at in times]


def decision(
    at: int, address: str = "10.0.0.1", *, action: str = "block", lasts: int = 0, name: str = "d1"
) -> Decision:
    return Decision(
        id=name, action=action, switch="s1", target=Target(kind="ip", address=address), reason="r",
        event_time=at, expires=at + lasts if lasts else 0,
    )  # fmt: skip


def test_no_packet_is_held_back_where_nothing_was_seen():
    assert QuietStretches(MINUTE, []).end(0) == 60
    assert QuietStretches(MINUTE, []).end(59) == 60


def test_packets_around_a_sign_are_held_back():
    """From ten seconds before to five seconds after it, and no others."""
    found = QuietStretches(MINUTE, signs(30 * SECOND))
    assert [found.end(at) for at in (0, 19, 20, 35, 36, 59)] == [20, 20, 20, 35, 60, 60]


def test_less_is_held_back_around_evidence_that_is_judged():
    """The feeder knows when it is."""
    found = QuietStretches(MINUTE, [Sign(30 * SECOND, judged=True)])
    assert quiet(found, 60) == [*range(27), *range(32, 60)]


def test_nothing_is_foretold_behind_the_first_decision_before_this_pass_has_made_it():
    """The packets behind it differ from those of the dry run: some are blocked."""
    found = QuietStretches(MINUTE, signs(30 * SECOND), decided=30 * SECOND)
    assert quiet(found, 60) == list(range(20))


def test_what_a_blocked_sender_did_in_the_dry_run_holds_nothing_up():
    """Others' signs do, and so do the decision itself, and the end of the block with the drops that are counted before it."""
    times = np.arange(900) * SECOND
    seen = signs(*range(30 * SECOND, 900 * SECOND, SECOND), senders=("02:00:00:00:00:01", "10.0.0.1"))
    seen += signs(300 * SECOND, senders=("02:00:00:00:00:02", "10.0.0.2"))
    found = QuietStretches(times, seen, decided=30 * SECOND)
    assert quiet(found, 900) == list(range(20))
    found.decide(decision(30 * SECOND, lasts=600 * SECOND))
    until = (630 * SECOND - COUNTED_NS) // SECOND
    assert quiet(found, 900) == [*range(20), *range(36, 290), *range(306, until)]
    found.decide(decision(630 * SECOND, action="unblock"))
    assert quiet(found, 900)[-1] == 619, "from then on the sender's signs count again"


def test_nothing_is_foretold_to_those_who_ask_for_certainty():
    found = QuietStretches(MINUTE, signs(30 * SECOND), decided=30 * SECOND, foresees=False)
    found.decide(decision(30 * SECOND))
    assert quiet(found, 60) == []


def test_a_sign_that_was_not_foretold_ends_all_quiet():
    found = QuietStretches(MINUTE, signs(30 * SECOND))
    found.hear(Sign(29 * SECOND))
    assert found.end(0) == 20
    found.hear(Sign(40 * SECOND))
    assert quiet(found, 60) == []


def test_behind_a_block_a_sign_that_was_not_foretold_holds_up_for_a_while():
    """From where the feeder is; what the blocked sender had in flight is no surprise."""
    times = np.arange(600) * SECOND
    found = QuietStretches(times, [], decided=0)
    found.decide(decision(0))
    assert found.end(100) == 600
    found.hear(Sign(90 * SECOND, ("10.0.0.1",)))
    assert found.end(100) == 600
    found.hear(Sign(90 * SECOND, ("10.0.0.2",)))
    hold = HOLD_NS // SECOND
    assert (found.end(100), found.end(100 + hold - 1), found.end(100 + hold)) == (100, 99 + hold, 600)
    found.hear(Sign(101 * SECOND))
    assert found.end(200) == 600, "until then it was expected"
    found.hear(Sign(150 * SECOND))
    assert (found.end(200), found.end(200 + hold)) == (200, 600)


def test_supporting_evidence_alone_holds_nothing_up():
    """It makes up a part of the bound at most; behind other evidence about the same sender it counts."""
    who = ("02:00:00:00:00:01", "10.0.0.1")
    seen = [Sign(at * SECOND, who, supporting=True) for at in (15, 40)]
    assert QuietStretches(MINUTE, seen).end(0) == 60
    found = QuietStretches(MINUTE, [*seen, Sign(30 * SECOND, who)])
    assert quiet(found, 60) == [*range(20), *range(46, 60)]
    found.hear(Sign(55 * SECOND, ("02:00:00:00:00:02",), supporting=True))
    assert found.end(0) == 20
    found.hear(Sign(55 * SECOND, who, supporting=True))
    assert found.end(0) == 0


@pytest.mark.parametrize(
    ("value", "senders"),
    [
        ({"sender": {"mac": "02:00:00:00:00:01", "ip": "10.0.0.1"}}, ("02:00:00:00:00:01", "10.0.0.1")),
        ({"sender": {"mac": "02:00:00:00:00:01", "ip": ""}}, ("02:00:00:00:00:01",)),
        ({"sender": None, "address": "10.0.0.1"}, ("10.0.0.1",)),
        ({"src": "10.0.0.1", "count": 40}, ("10.0.0.1",)),
        ({"dst": "10.0.0.9", "count": 40}, ()),
        ([1, 2], ()),
    ],
)
def test_sign_says_whom_it_is_about(value, senders):
    assert sign_of(value, 7, judged=False) == Sign(7, senders)
    if isinstance(value, dict):
        supporting = value | {"supporting": True}
        assert sign_of(supporting, 7, judged=True) == Sign(7, senders, supporting=True, judged=True)


@given(times=TIMES, found=TIMES, decided=st.none() | st.integers(0, 120 * SECOND))
def test_like_a_twin_that_looks_at_each_packet(times, found, decided):
    """Whatever the order of times and signs."""

    def is_loud(at: int) -> bool:
        return any(sign - BEFORE_NS <= at <= sign + AFTER_NS for sign in found)

    expected, is_behind = [], False
    for index, at in enumerate(times):
        is_behind = is_behind or (decided is not None and at >= decided - BEFORE_NS)
        if not is_behind and not is_loud(at):
            expected.append(index)
    made = QuietStretches(np.array(times, np.int64), signs(*found), decided)
    assert quiet(made, len(times)) == expected


def test_a_lap_is_needed_for_each_half_second_that_has_packets():
    assert laps(np.array([], np.int64), SECOND // 2) == 0
    assert laps(np.array([1, 2, 3], np.int64), SECOND // 2) == 1
    assert laps(np.repeat(MINUTE, 100), SECOND // 2) == 60
