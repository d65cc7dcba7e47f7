"""Byte strings of any canonical or padded length become the numbers they stand for."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from apps.p4runtime_ctrl.southbound.rows import RowLayout, has_bit
from apps.p4runtime_ctrl.southbound.values import canonical

WIDTHS = {"flag": 1, "port": 9, "number": 32, "clock": 48, "address": 128, "map": 256}
rows = st.tuples(*(st.integers(0, (1 << width) - 1) for width in WIDTHS.values()))


def read(record):
    address = int(record["address"][0]) << 64 | int(record["address"][1])
    plain = [int(record[name]) for name in ("flag", "port", "number", "clock")]
    return (*plain, address, int.from_bytes(record["map"].tobytes(), "big"))


@given(st.lists(rows, min_size=1, max_size=20), st.sampled_from([0, 1, 40]))
def test_rows_are_read_back(numbers, padding):
    layout = RowLayout(WIDTHS.items())
    found = layout.array([[b"\0" * padding + canonical(value) for value in row] for row in numbers])
    assert [read(record) for record in found] == numbers


@given(st.lists(st.integers(0, (1 << 256) - 1), min_size=1), st.integers(0, 255))
def test_bits_of_maps(maps, bit):
    array = np.frombuffer(b"".join(each.to_bytes(32, "big") for each in maps), np.uint8).reshape(-1, 32)
    assert has_bit(array, bit).tolist() == [bool(each >> bit & 1) for each in maps]


def test_no_rows():
    assert len(RowLayout(WIDTHS.items()).array([])) == 0
