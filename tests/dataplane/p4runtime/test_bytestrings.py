"""Byte strings are the shortest big-endian form of a number, and longer forms are understood."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataplane.p4runtime.bytestrings import decode, encode
from dataplane.p4runtime.status import OutOfRange


@given(st.integers(0, (1 << 256) - 1), st.integers(0, 4))
def test_a_number_comes_back_whatever_zeros_stand_before_it(value, zeros):
    assert decode(bytes(zeros) + encode(value), 256, "x") == value


@given(st.integers(0, (1 << 256) - 1))
def test_no_shorter_string_says_the_same(value):
    data = encode(value)
    assert len(data) == 1 or data[0]
    assert len(data) == max(1, (value.bit_length() + 7) // 8)


@pytest.mark.parametrize(
    ("data", "width"),
    [(b"", 8), (b"\x01\x63", 8), (b"\x10\x63", 12), (b"\x01\x00\x63", 16), (b"\x02\x00", 9)],
)
def test_what_does_not_fit_is_refused(data, width):
    with pytest.raises(OutOfRange, match="field"):
        decode(data, width, "field")
