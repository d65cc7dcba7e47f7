"""The latest documents of some keys, by index: of a large collection no more are read than a limit needs.

    keys ─► documents of each, the latest to begin first ─► merged ─► the latest to end first ─► `latest_items`

A server with an index on key and time delivers the documents of one key in this order without sorting, and stops when
nobody asks for more; a server without one sorts, with the same result.
"""

import math
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from heapq import heappop, heappush, merge
from typing import Any, Final, TypeAlias

from due.drivers.mongodb_retention import number

Document: TypeAlias = dict[str, Any]

HEAD: Final = {"dataKey": 1, "timestamp": 1, "lastTimestamp": 1}
"""The fields that say when a document's items were written."""
_MOST_KEYS = 256
"""Keys that are asked for one by one; with more, a question for each costs more than reading every document's times."""
_LEAST_BATCH, _MOST_BATCH = 100, 1000
_MORE = 16
"""Documents beyond the limit, which show that no later item comes."""
_AHEAD = 20_000
"""Documents that are read ahead, of all keys together."""


def named_keys(criteria: Mapping[str, Any]) -> Sequence[str] | None:
    """The keys to which a filter is limited; None if there are none or too many to ask for one by one.

    Args:
        criteria: a filter as `ArchiveQuery.to_mongo` makes it.
    """
    test = criteria.get("dataKey", {})
    if test.keys() == {"$eq"}:
        return [test["$eq"]]
    if test.keys() == {"$in"} and len(test["$in"]) <= _MOST_KEYS:
        return list(dict.fromkeys(test["$in"]))
    return None


def batch_size(limit: int, keys: int) -> int:
    """Documents of one key that are asked for at a time.

    Args:
        limit: items that are wanted.
        keys: how many keys are read side by side.
    """
    wanted = min(max(limit + _MORE, _LEAST_BATCH), _MOST_BATCH)
    return max(2, min(wanted, _AHEAD // max(1, keys)))


def latest_to_end(
    keys: Iterable[str], read: Callable[[str], Generator[Document, None, None]], span: int
) -> Iterator[tuple[int, Document]]:
    """The documents of all keys with the time of their last item, the greatest first.

    Args:
        keys: each once.
        read: the documents of a key by `timestamp`, the greatest first; closed at the end.
        span: the most nanoseconds between the first and the last item of a document.
    """
    waiting: list[tuple[int, int, Document]] = []
    with ExitStack() as open_reads:
        each = [open_reads.enter_context(closing(read(key))) for key in keys]
        for place, document in enumerate(merge(*each, key=_begin, reverse=True)):
            latest = _begin(document) + span  # no document from here on ends later
            while waiting and -waiting[0][0] >= latest:
                yield -waiting[0][0], heappop(waiting)[2]
            heappush(waiting, (-number(document, "lastTimestamp"), place, document))
    while waiting:
        yield -waiting[0][0], heappop(waiting)[2]


def _begin(document: Document) -> float:
    """The time of the first item; where it is damaged, what is not a number comes where BSON's order has it."""
    begin = document.get("timestamp")
    if begin is None or (isinstance(begin, float) and math.isnan(begin)):
        return -math.inf
    return begin if isinstance(begin, int | float) and not isinstance(begin, bool) else math.inf
