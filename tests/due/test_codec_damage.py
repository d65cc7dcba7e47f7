"""Values of ours that are too short or too large are refused as damage."""

import pytest

from due.codec import decode_value
from due.errors import DecodeError

NAIVE_DATETIME, DATETIME64 = 1, 2


@pytest.mark.parametrize(
    ("code", "data"),
    [(NAIVE_DATETIME, b"abc"), (NAIVE_DATETIME, b"\xff" * 7 + b"\x7f"), (DATETIME64, b"abc")],
    ids=["short time", "time beyond the calendar", "short numpy time"],
)
def test_damaged_times_are_no_crash(code, data):
    with pytest.raises(DecodeError):
        decode_value(bytes([0xC7, len(data), code]) + data)
