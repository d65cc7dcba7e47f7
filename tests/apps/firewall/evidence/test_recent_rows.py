"""The last rows of many small batches: all there, in order, in few blocks, and not too many."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from apps.firewall.evidence.recent_rows import RecentRows
from due import RecordBatch

steps = st.lists(
    st.tuples(st.integers(0, 100), st.sampled_from([0.0, 0.03, 0.2, 5.0]), st.booleans()), max_size=120
)  # rows, seconds later, whether somebody looks


def batch(first: int, rows: int) -> RecordBatch:
    return RecordBatch({"number": np.arange(first, first + rows, dtype=np.int64), "other": np.zeros(rows)})


def numbers(recent: RecentRows) -> list[int]:
    return [number for _, block in recent.blocks() for number in block["number"].tolist()]


@given(steps)
def test_the_last_rows_are_kept_in_order_whoever_looks_meanwhile(given_steps):
    recent, now, count = RecentRows(("number",), 1_000), 0.0, 0
    for rows, later, looks in given_steps:
        now += later
        recent.add(batch(count, rows), now)
        count += rows
        if looks:
            numbers(recent)
    kept = numbers(recent)
    assert kept == list(range(count - len(kept), count))
    assert len(kept) == len(recent)
    assert min(count, 1_000) <= len(kept) < 1_000 + 2 * 1_000


def test_small_batches_make_few_blocks():
    recent = RecentRows(("number",), 10_000)
    for number in range(5_000):
        recent.add(batch(number, 1), number / 1e6)
    assert len(list(recent.blocks())) <= 6
    assert all(set(block) == {"number"} for _, block in recent.blocks())


def test_rows_that_came_far_apart_are_told_apart():
    recent = RecentRows(("number",), 100)
    recent.add(batch(0, 2), 1.0)
    recent.add(batch(2, 1), 2.0)
    assert [(came, block["number"].tolist()) for came, block in recent.blocks()] == [
        (1.0, [0, 1]),
        (2.0, [2]),
    ]


def test_rows_that_come_one_by_one_make_few_blocks_too():
    recent = RecentRows(("number",), 10_000)
    for number in range(12_000):
        recent.add(batch(number, 1), 0.2 * number)
    assert len(list(recent.blocks())) < 10_000 / 64 + 120
    assert all(block["number"].base is None for _, block in recent.blocks()), "nothing else is kept alive"
