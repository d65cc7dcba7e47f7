"""Requests to a switch for its counting cells."""

from itertools import count
from typing import Final, Literal

import msgspec

TIMEOUT_S: Final = 10.0
"""Seconds after which an answer is not waited for any longer."""
LATE: Final = "cells were read when a later window had begun to overwrite them: a count may be too low"
_NUMBERS: Final = count(1)


class CellRead(msgspec.Struct, frozen=True, kw_only=True):
    """A question: the count of a key in a window, or what waits for the end of a window."""

    id: int = msgspec.field(default_factory=lambda: next(_NUMBERS))
    """Unlike that of any other question of this process."""
    bit: int
    source: int = 0
    destination: int = 0
    port: int = 0
    length: int = 0
    source_port: int = 0
    time_us: int
    sweep: Literal[0, 1, 2] = 0
    """0: the count of a key.  1: take the first key that waits out of the query's ring, as a frame would;
    answered where more wait.  2: the same, always answered.  At 0, `time_us` is 'now'."""
