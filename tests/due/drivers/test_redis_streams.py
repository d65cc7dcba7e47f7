"""A send window keeps what readers still need, within its size, and knows who is alive."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from due.drivers.redis_progress import Question
from due.drivers.redis_streams import LEAST_PAUSE, NOBODY, NOTHING, SendWindow, next_pause, parse_id
from due.errors import UpdatesUnavailable


def _window(**changes):
    fields = {"size": 5000, "retain": 2000, "group_timeout": 30.0, **changes}
    return SendWindow("a.b", **fields)


def _add(window, count, size=300):
    for _ in range(count):
        entry = window.add(bytes(size))
        entry.id = (len(window.kept) + len(window.retained), 0)


def test_the_window_bounds_what_is_kept():
    window = _window()
    while window.has_room(300):
        _add(window, 1)
    assert window.kept_bytes <= 5000
    assert window.half_full


def test_a_lone_payload_larger_than_the_window_passes():
    assert _window().has_room(10**9)


def test_acknowledged_payloads_are_retained_up_to_a_limit_then_trimmed():
    window = _window()
    _add(window, 8)
    window.acknowledged((6, 0))
    assert [e.id for e in window.kept] == [(7, 0), (8, 0)]
    assert window.trim_point() == (3, 0)
    assert [e.id for e in window.retained] == [(3, 0), (4, 0), (5, 0), (6, 0)]
    assert window.trim_point() is None
    assert window.trim_point(streams=2) == (5, 0), "streams of one process share the limit"


def test_of_a_path_with_few_items_those_of_the_last_hour_are_retained():
    """By the server's clock; they would take hours to come to their bytes, and memory would grow all the time."""
    window = _window(retain=1 << 20, retain_s=3600.0)
    minute_ms = 60_000
    for minute in range(180):
        window.add(b"x").id = (minute * minute_ms, 0)
        window.acknowledged((minute * minute_ms, 0))
        window.trim_point()
    assert len(window.retained) == 61
    assert window.retained[0].id == (119 * minute_ms, 0)


def test_times_of_an_earlier_server_say_nothing():
    window = _window(retain=1 << 20, retain_s=0.0)
    _add(window, 3)
    window.acknowledged((3, 0))
    window.forget_ids(100.0)
    assert window.trim_point() is None
    assert len(window.retained) == 3


def test_what_a_late_group_has_not_read_is_not_behind_it_after_a_restart():
    """While nobody seems to read, payloads are retained; a group may be found that still reads them."""
    window = SendWindow("a.b", 1000, 10_000, 30.0)
    for number in range(1, 6):
        window.add(b"x").id = (number, 0)
    window.acknowledged(NOBODY)
    assert window.unread() == 0
    window.acknowledged(NOTHING)
    assert window.unread() == 5, "a group was found, not known how far it is"
    window.acknowledged((2, 0))
    assert window.unread() == 3
    window.acknowledged(NOTHING)
    assert window.unread() == 3, "an answer that says nothing changes nothing"
    window.forget_ids(100.0)
    assert (len(window.retained), len(window.kept)) == (2, 3)
    window.forget_ids(100.0)
    assert len(window.kept) == 3, "the server restarts again before it has been told everything"
    assert window.awaits_readers(102.0), "others may have begun to read as well"
    assert not window.awaits_readers(104.0)


def test_what_the_server_has_not_answered_is_never_forgotten():
    window = _window()
    window.add(b"")
    window.acknowledged((2**63, 0))
    assert len(window.kept) == 1


def test_groups_live_by_their_leases_even_after_the_server_lost_them():
    window, seconds = _window(group_timeout=3.0), iter(range(100, 200))

    def look(**leases):
        now = float(next(seconds))
        return window.live_groups({f.replace("_", "/").encode(): v for f, v in leases.items()}, now, now)

    assert look(kitsune_1=b"7", gone_1=b"5", left_1=b"0") == {b"kitsune", b"gone"}
    for number in range(3):
        assert look(kitsune_1=b"%d" % number, gone_1=b"5", left_1=b"0")
    assert look(kitsune_1=b"4", gone_1=b"5") == {b"kitsune"}
    assert look() == {b"kitsune"}
    assert look(kitsune_1=b"0", kitsune_2=b"1") == {b"kitsune"}
    assert look(kitsune_2=b"0") == set()


def test_ids_of_an_earlier_life_of_the_server_trim_nothing():
    """Its clock may be behind them: what is new would be deleted."""
    window = _window()
    _add(window, 8)
    window.acknowledged((8, 0))
    window.forget_ids(0.0)
    assert window.trim_point() is None
    window.acknowledged((2**63, 0))
    assert not window.kept


def test_ids_compare_as_numbers():
    assert parse_id(b"9-10") < parse_id("10-2") < parse_id("10-10")
    assert parse_id("5") == (5, 0)


def test_excess_is_what_is_kept_beyond_a_share_of_the_window():
    window = _window()
    assert window.excess(0.0) == 0, "nothing is kept"
    _add(window, 8)
    assert window.excess(0.5) == window.kept_bytes - 2500
    assert window.excess(1.0) == 0


@pytest.mark.parametrize(
    ("waited", "freed", "missing", "seconds"),
    [
        (0.02, 1000, 2000, 0.04),  # at the readers' pace
        (0.02, 0, 2000, 0.04),  # nothing moves: more and more rarely
        (0.02, 1, 2000, 0.1),  # never longer than the limit
        (0.02, 1000, 1, LEAST_PAUSE),  # nor so soon that asking is all there is
    ],
)
def test_a_writer_asks_again_when_the_readers_pace_lets_expect_room(waited, freed, missing, seconds):
    assert next_pause(waited, freed, missing, 0.1) == pytest.approx(seconds)


_REPLIES = st.recursive(
    st.none()
    | st.integers(-5, 2**64)
    | st.sampled_from([b"name", b"pending", b"last-delivered-id", b"5-1", b"x", b"group", b"group/one"])
    | st.binary(max_size=3),
    lambda inner: st.lists(inner, max_size=6),
    max_leaves=20,
)


@given(st.lists(_REPLIES, min_size=4, max_size=4))
def test_whatever_the_server_answers_nothing_is_forgotten_by_mistake(replies):
    window = _window()
    window.groups = window.known = (b"group",)
    _add(window, 3)
    question = Question(window)
    window.asking(0.0)
    for reply in replies:
        question.take(reply)
    try:
        position = question.answer()
    except UpdatesUnavailable:
        return
    window.acknowledged(position)
    assert len(window.kept) + len(window.retained) == 3


@given(_REPLIES)
def test_an_id_is_read_or_refused(reply):
    try:
        assert len(parse_id(reply)) == 2
    except UpdatesUnavailable:
        return
