"""The last rows of a stream of record batches, joined into blocks.

Under a flood thousands of batches of one to five rows arrive; kept singly, each would cost kilobytes and a
round of numpy calls per lookup.  In quiet times rows arrive one by one, so blocks are small; they are joined
again once their exact time no longer matters.  Blocks are copies, since received columns are views that keep
their whole message in memory.
"""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from due import RecordBatch

Columns = Mapping[str, NDArray[Any]]

_BLOCK_ROWS: Final = 1024
_BLOCK_S: Final = 0.1
"""Seconds; rows that arrived further apart are in different blocks."""
AGED_S: Final = 10.0
_AGED_BLOCKS: Final = 64
"""Number of blocks that are joined when the newest of them has aged."""


class RecentRows:
    """Keeps `columns` of at least the last `rows` rows, whole blocks only.  Pure: the caller brings the time.

    Rows that arrived more than `aged_s` ago may share a block although they arrived at different times.

    >>> recent = RecentRows(("port",), 100)
    >>> for number in range(3):
    ...     recent.add(RecordBatch({"port": np.array([number], np.uint16)}), 5.0)
    >>> [(came, block["port"].tolist()) for came, block in recent.blocks()]
    [(5.0, [0, 1, 2])]
    """

    def __init__(self, columns: Sequence[str], rows: int, *, aged_s: float = AGED_S) -> None:
        self._columns = tuple(columns)
        self._aged_s = aged_s
        self._rows = rows
        self._block_rows = max(1, min(_BLOCK_ROWS, rows // 8))
        self._aged: deque[tuple[float, Columns]] = deque()
        self._blocks: deque[tuple[float, Columns]] = deque()
        self._kept = 0
        self._fresh: list[Columns] = []
        self._fresh_rows = 0
        self._begun = self._newest = 0.0

    def __len__(self) -> int:
        return self._kept

    def add(self, batch: RecordBatch, now: float) -> None:
        """Add rows that arrived at `now`, in seconds; raises KeyError for a missing column."""
        if not len(batch):
            return
        if self._fresh and (self._fresh_rows >= self._block_rows or now - self._begun > _BLOCK_S):
            self._blocks.append((self._newest, self._joined(self._fresh)))
            self._fresh, self._fresh_rows = [], 0
            self._gather(now)
        if not self._fresh:
            self._begun = now
        self._fresh.append({name: batch[name] for name in self._columns})
        self._fresh_rows += len(batch)
        self._newest = now
        self._kept += len(batch)
        while oldest := self._aged or self._blocks:
            if self._kept - self._size(oldest[0]) < self._rows:
                break
            self._kept -= self._size(oldest.popleft())

    def blocks(self) -> Iterator[tuple[float, Columns]]:
        """Arrival time of the newest row of each block, and its columns; oldest first."""
        yield from self._aged
        yield from self._blocks
        if self._fresh:
            self._fresh = [self._joined(self._fresh)]
            yield self._newest, self._fresh[0]

    def _gather(self, now: float) -> None:
        if len(self._blocks) < _AGED_BLOCKS or now - self._blocks[_AGED_BLOCKS - 1][0] < self._aged_s:
            return
        aged = [self._blocks.popleft() for _ in range(_AGED_BLOCKS)]
        self._aged.append((aged[-1][0], self._joined([block for _, block in aged])))

    def _joined(self, blocks: Sequence[Columns]) -> Columns:
        return {name: np.concatenate([each[name] for each in blocks]) for name in self._columns}

    def _size(self, block: tuple[float, Columns]) -> int:
        return len(block[1][self._columns[0]])
