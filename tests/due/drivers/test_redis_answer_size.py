"""A reader far from its server asks for more entries at once, within a bound of bytes."""

import pytest

from due.drivers.redis_work import COUNT, MOST_ANSWER_BYTES, MOST_COUNT, SLOW_SECONDS, AnswerSize


def _after(laps: int, *, lap: float, entry: int, fixed: bool = False) -> AnswerSize:
    """Full answers of entries of so many bytes, after round trips of so many seconds."""
    size = AnswerSize(fixed=fixed)
    for number in range(laps):
        size.asked(size.most_given, float(number))
        size.answered(number + lap)
        size.came(size.count, size.count * entry)
    return size


def test_small_entries_from_far_away_come_in_great_numbers():
    assert _after(20, lap=0.1, entry=1_000).count == MOST_COUNT


@pytest.mark.parametrize(
    "near", [{"lap": SLOW_SECONDS / 2, "entry": 1_000}, {"lap": 0.1, "entry": 1_000, "fixed": True}]
)
def test_from_nearby_and_in_shared_groups_few_are_asked_for(near):
    assert _after(20, **near).count == COUNT


def test_an_answer_does_not_outgrow_its_bytes():
    size = _after(20, lap=0.1, entry=MOST_ANSWER_BYTES // (4 * COUNT))
    assert COUNT < size.count < MOST_COUNT
    assert size.count * (MOST_ANSWER_BYTES // (4 * COUNT)) <= MOST_ANSWER_BYTES


def test_when_entries_become_large_or_few_less_is_asked_for_again():
    large = _after(20, lap=0.1, entry=1_000)
    for _ in range(20):
        large.came(large.count, large.count * (96 << 10))
    assert large.count == COUNT
    few = _after(20, lap=0.1, entry=1_000)
    for _ in range(20):
        few.came(1, 1_000)
    assert few.count == COUNT
