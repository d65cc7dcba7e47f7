"""How many keys there are is learnt from the frames of keys without a cell."""

import msgspec
import numpy as np
import pytest

from apps.sonata_adapter.planner.cell_needs import CellNeeds, fewest, keys_of
from apps.sonata_adapter.planner.placement import StageEntry
from due import RecordBatch

ENTRY = StageEntry(
    role="reduce",
    bit=3,
    stage=0,
    match={"protocol": 6},
    masks=(("destination_mask", (1 << 128) - 1), ("port_mask", 65_535)),
    threshold=40,
    by_bytes=0,
    window_us=1_000_000,
    size=8_192,
)
MINUTE_US = 60_000_000


def reports(keys, at_us):
    """Two frames of each key, all of keys without a cell."""
    numbers = np.repeat(np.array(keys, dtype=np.uint64), 2)
    zeros = np.zeros(len(numbers), dtype=np.uint64)
    ports = np.full(len(numbers), 80, dtype=np.int32)
    return RecordBatch(
        {
            "time_us": np.full(len(numbers), at_us, dtype=np.int64),
            "overflow": np.ones(len(numbers), dtype=np.uint8),
            "ip_src_hi": zeros,
            "ip_src_lo": np.arange(len(numbers), dtype=np.uint64),
            "ip_dst_hi": zeros,
            "ip_dst_lo": numbers,
            "tcp_sport": ports,
            "udp_sport": ports - 81,
            "tcp_dport": ports,
            "udp_dport": ports - 81,
            "length": ports.astype(np.int64),
        }
    )


def watched(busy, minutes, *, keys=246, entry=ENTRY):
    """What is known when so many seconds, of some minutes, had keys without a cell; a look every two seconds."""
    needs = CellNeeds()
    for at_us in range(0, minutes * MINUTE_US, 2_000_000):
        needs.look({entry.bit: entry}, {"s1": at_us})
        if at_us // 1_000_000 in busy:
            needs.reported("s1", entry.bit, reports(range(keys), at_us), {entry.bit: entry}, 0)
    needs.look({entry.bit: entry}, {"s1": minutes * MINUTE_US})
    return needs


@pytest.mark.parametrize(("keys", "cells"), [(100, 64), (300, 8_192), (2_100, 8_192), (50_000, 8_192)])
def test_keys_in_all_follow_from_those_without_a_cell(keys, cells):
    """Thrown into cells by chance."""
    rng = np.random.default_rng(7)
    without = [keys - len(np.unique(rng.integers(cells, size=keys))) for _ in range(50)]
    assert keys_of(round(float(np.mean(without))), cells) == pytest.approx(keys, rel=0.06)


def test_where_no_key_is_without_a_cell_there_are_few():
    assert keys_of(0, 8_192) == 0
    assert keys_of(3, 8_192) == pytest.approx(fewest(8_192), rel=0.02)


def test_many_keys_need_eight_cells_each():
    """In a power of two; how many there are is said in words."""
    needs = watched({10, 12, 20}, 1)
    assert needs.wanted(ENTRY) == 32_768
    assert needs.told([ENTRY]) == {3: "8,192 cells, 2,100 keys seen"}


def test_one_window_is_no_need():
    """Nor is a single burst that is over."""
    needs = watched({10}, 1)
    assert needs.wanted(ENTRY) == 0
    assert needs.told([ENTRY]) == {3: "8,192 cells, fewer than 222 keys"}


def test_keys_are_remembered_whatever_bit_and_stage_count_them():
    """Over a re-plan, by what is counted; another count has keys of its own."""
    needs = watched({10, 12}, 1)
    moved = msgspec.structs.replace(ENTRY, bit=9, stage=4)
    assert needs.wanted(moved) == needs.wanted(ENTRY) > 0
    other = msgspec.structs.replace(ENTRY, match={"protocol": 17})
    assert needs.wanted(other) == 0


def test_fewer_cells_are_enough_after_minutes_only():
    assert watched(set(), 9).enough(ENTRY) is None
    assert watched(set(), 11).enough(ENTRY) == 2_048


def test_keys_that_come_back_each_minute_keep_their_cells():
    """Between them nobody is without a cell; a quarter of an hour after the last they are forgotten."""
    each = {second for minute in range(20) for second in (60 * minute, 60 * minute + 2)}
    assert watched(each, 20).enough(ENTRY) >= 8_192
    assert watched({second for second in each if second < 600}, 25).enough(ENTRY) == 2_048


def test_gates_are_left_alone():
    """They report no frame, so that silence says nothing."""
    gate = msgspec.structs.replace(ENTRY, role="gate", count_of=ENTRY.bit)
    needs = watched(set(), 11, entry=gate)
    assert needs.enough(gate) is None
    assert needs.told([gate]) == {3: "8,192 cells"}


def test_a_clock_that_begins_anew_is_followed():
    """Windows of the old clock say nothing of the new one."""
    needs = watched({10, 12}, 11)
    needs.look({3: ENTRY}, {"s1": 0})
    assert needs.enough(ENTRY) is None
    for at_us in (2_000_000, 4_000_000):
        needs.reported("s1", 3, reports(range(500), at_us), {3: ENTRY}, 0)
    needs.look({3: ENTRY}, {"s1": 6_000_000})
    assert needs.wanted(ENTRY) == 32_768


def test_entries_that_are_not_planned_are_forgotten():
    needs = watched({10, 12}, 1)
    assert needs.known
    for minute in range(12):
        needs.look({}, {"s1": (1 + minute) * MINUTE_US})
    assert not needs.known
    assert needs.wanted(ENTRY) == 0
