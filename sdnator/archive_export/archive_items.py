"""Items of a period of the archive, in pieces that fit into memory."""

from collections.abc import Iterator
from typing import Final

from due import Item, RecordBatch
from due.drivers.base import ArchiveDriver

_FIRST_NS: Final = 60 * 10**9
_SHORTEST_NS: Final = 10**8
_LONGEST_NS: Final = 3_600 * 10**9
_MANY_ROWS: Final = 1_000_000
_FEW_ROWS: Final = 200_000


def archived_items(archive: ArchiveDriver, pattern: str, begin: int, end: int) -> Iterator[Item]:
    """Items of a period, in the order of the archive.

    A piece is as long as it takes to hold some hundred thousand rows, so memory is bounded by a tenth of a second of
    what was written.

    Args:
        archive: read in pieces while the items are taken.
        pattern: a key, with wildcards or without.
        begin: only items written from then on, ns.
        end: only items written before, ns.

    Raises:
        BackendError: the archive failed.
    """
    length = _FIRST_NS
    while begin < end:
        until = min(begin + length, end)
        found = archive.find({"dataKey": pattern, "timestamp": {"$gte": begin, "$lt": until}})
        yield from found
        rows = sum(len(item.value) if isinstance(item.value, RecordBatch) else 1 for item in found)
        if rows > _MANY_ROWS:
            length = max(length // 4, _SHORTEST_NS)
        elif rows < _FEW_ROWS:
            length = min(2 * length, _LONGEST_NS)
        begin = until
