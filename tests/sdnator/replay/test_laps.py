"""Where laps end: by capture times alone, compared with a slow twin that walks packet by packet."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sdnator.replay.laps import Laps

SECOND = 1_000_000_000


def ends(laps: Laps, packets: int, first: int = 0) -> list[int]:
    found, at = [], first
    while at < packets:
        at = laps.end(at)
        found.append(at)
    return found


def test_a_lap_has_the_packets_of_one_reaction_time_and_no_more_than_fit():
    times = np.array([0, 1, 2, 3, 499, 500, 999, 1_000, 5_000], np.int64) * SECOND // 1_000
    assert ends(Laps(times, SECOND // 2, 3), 9) == [3, 5, 7, 8, 9]
    assert ends(Laps(times, SECOND // 2, 100), 9) == [5, 7, 8, 9]


def test_it_does_not_matter_where_laps_begin():
    """Behind a stretch that was sent freely laps end where they would have ended without it."""
    laps = Laps(np.arange(1_000) * SECOND // 40, SECOND // 2, 16)
    everywhere = set(ends(laps, 1_000))
    assert all(set(ends(laps, 1_000, first)) <= everywhere for first in range(0, 1_000, 7))


def test_the_end_of_a_block_parts_a_lap():
    laps = Laps(np.arange(10) * SECOND // 10, SECOND, 100)
    assert laps.end(0) == 10
    assert laps.end(0, before_ns=SECOND // 2) == 5
    assert laps.end(5, before_ns=SECOND // 2) == 6, "at least one packet"
    assert laps.end(0, before_ns=7 * SECOND) == 10


def test_no_packets_have_no_laps():
    assert len(Laps(np.array([], np.int64), SECOND, 16)) == 0


@given(
    times=st.lists(st.integers(0, 5 * SECOND), min_size=1, max_size=60),
    reaction=st.integers(SECOND // 10, SECOND),
    most=st.integers(1, 9),
)
def test_like_a_twin_that_looks_at_each_packet(times, reaction, most):
    """Also where capture time runs backwards."""
    expected, inside = [], 0
    for index, at in enumerate(times):
        cell = (at - min(times)) // reaction
        before = (times[index - 1] - min(times)) // reaction if index else None
        inside = inside + 1 if cell == before else 0
        if index and inside % most == 0:
            expected.append(index)
    assert ends(Laps(np.array(times, np.int64), reaction, most), len(times)) == [*expected, len(times)]
