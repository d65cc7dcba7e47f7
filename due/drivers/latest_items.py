"""The latest items of a large archive without reading all of it.  Pure: the driver reads rows."""

from collections.abc import Callable, Iterable, Sequence
from itertools import islice
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

    Args:
        heads: for each candidate row its greatest timestamp (ns) and its name for `read`, the greatest first; no more
            of them are taken than needed.
        read: the items of some rows.
        limit: how many items.
    """
    rows = iter(heads)
    items: list[Item] = []
    while some := list(islice(rows, _ROWS)):
        if len(items) >= limit and items[0].timestamp > some[0][0]:
            break
        items += read([name for _, name in some])
        items.sort(key=by_age)
        del items[: max(0, len(items) - limit)]
    return items
