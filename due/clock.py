"""The clock by which a process notices that it was stopped."""

import time
from collections.abc import Callable
from functools import partial

awake_ns: Callable[[], int] = partial(
    time.clock_gettime_ns, getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
)
"""Nanoseconds of a clock that nobody sets and that goes on while the machine is suspended (Linux)."""
