"""The last rows of a stream of record batches, joined into blocks.

Under a flood batches of one to five rows come by the thousand; kept as they come, each would cost kilobytes
and a round of numpy calls whenever somebody looks.
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
"""Rows that came further apart are in different blocks."""


class RecentRows:
    """Keeps `columns` of at least the last `rows` rows, whole blocks only.  Pure: the caller brings the time.

    >>> recent = RecentRows(("port",), 100)
    >>> for number in range(3):
    ...     recent.add(RecordBatch({"port": np.array([number], np.uint16)}), 5.0)
    >>> [(came, block["port"].tolist()) for came, block in recent.blocks()]
    [(5.0, [0, 1, 2])]
    """

    def __init__(self, columns: Sequence[str], rows: int) -> None:
        self._columns = tuple(columns)
        self._rows = rows
        self._block_rows = max(1, min(_BLOCK_ROWS, rows // 8))
        self._blocks: deque[tuple[float, Columns]] = deque()
        self._kept = 0
        self._fresh: list[Columns] = []
        self._fresh_rows = 0
        self._begun = self._newest = 0.0

    def __len__(self) -> int:
        return self._kept

    def add(self, batch: RecordBatch, now: float) -> None:
        """Rows that came at `now`, in seconds; raises KeyError for a column that they lack."""
        if not len(batch):
            return
        if self._fresh and (self._fresh_rows >= self._block_rows or now - self._begun > _BLOCK_S):
            self._blocks.append((self._newest, self._joined()))
            self._fresh, self._fresh_rows = [], 0
        if not self._fresh:
            self._begun = now
        self._fresh.append({name: batch[name] for name in self._columns})
        self._fresh_rows += len(batch)
        self._newest = now
        self._kept += len(batch)
        while self._blocks and self._kept - self._size(self._blocks[0]) >= self._rows:
            self._kept -= self._size(self._blocks.popleft())

    def blocks(self) -> Iterator[tuple[float, Columns]]:
        """When the newest row of each block came, and its columns; oldest first."""
        yield from self._blocks
        if self._fresh:
            self._fresh = [self._joined()]
            yield self._newest, self._fresh[0]

    def _joined(self) -> Columns:
        if len(self._fresh) == 1:
            return self._fresh[0]
        return {name: np.concatenate([each[name] for each in self._fresh]) for name in self._columns}

    def _size(self, block: tuple[float, Columns]) -> int:
        return len(block[1][self._columns[0]])
