"""The latest items of a large archive without reading all of it.  Pure: the driver reads rows."""

from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from typing import TypeVar

from due.messages import Item

_ROWS = 16
R = TypeVar("R")

by_age = attrgetter("timestamp", "sequence", "instance_id", "key")


def latest_items(
    heads: Iterable[tuple[int, R]], read: Callable[[Sequence[R]], Iterable[Item]], limit: int
) -> list[Item]:
    """The latest `limit` items, oldest first.

    `heads`: for each candidate row its greatest timestamp (ns) and its name for `read`.
    """
    rows = sorted(heads, key=lambda head: head[0], reverse=True)
    items: list[Item] = []
    for start in range(0, len(rows), _ROWS):
        if len(items) >= limit and items[0].timestamp > rows[start][0]:
            break
        items += read([name for _, name in rows[start : start + _ROWS]])
        items.sort(key=by_age)
        del items[: max(0, len(items) - limit)]
    return items
