"""Waiting for other threads and processes, with a deadline and a reason."""

import time
from collections.abc import Callable

_LOOK_S = 0.01


class TookTooLong(AssertionError):
    """A condition did not hold in time; the text says what was found instead."""


def wait_for(condition: Callable[[], object], seconds: float = 90.0, why: Callable[[], object] = str) -> None:
    """Return as soon as a condition holds.

    Args:
        condition: asked every 10 ms.
        seconds: how long at most.
        why: asked for the message at the end, such as a log.

    Raises:
        TookTooLong: the condition did not hold in time.
    """
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() >= deadline:
            raise TookTooLong(f"not within {seconds:g} s: {why()}")
        time.sleep(_LOOK_S)
