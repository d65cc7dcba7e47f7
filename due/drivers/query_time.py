"""A time limit for queries: `with time_limit(10): engine.get(...)`, for servers that query for others."""

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

from due.errors import Timeout

T = TypeVar("T")
_deadline: ContextVar[float | None] = ContextVar("due-query-deadline", default=None)


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Queries of this thread that take longer raise `due.errors.Timeout`."""
    token = _deadline.set(time.monotonic() + seconds)
    try:
        yield
    finally:
        _deadline.reset(token)


def time_left() -> float | None:
    """Seconds left; None without a limit.  Raises `Timeout` if none are left."""
    deadline = _deadline.get()
    if deadline is None:
        return None
    left = deadline - time.monotonic()
    if left <= 0:
        raise Timeout("the query takes too long: narrow it by key and time")
    return left


def in_time(elements: Iterable[T]) -> Iterator[T]:
    """The same elements; raises `Timeout` when the time is over."""
    for element in elements:
        time_left()
        yield element
