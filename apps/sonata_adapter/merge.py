"""Several streams of one switch's packets → one stream in the order of arrival, each packet once.

The controller publishes what it copies under one key for each condition; a packet that meets two
conditions comes twice.  Packets wait until every stream has come as far, or has been silent for
`hold_s` of the caller's clock.
"""

from typing import Final

import numpy as np

from due import RecordBatch

DEFAULT_HOLD_S: Final = 0.2
_MOST_ROWS: Final = 1 << 18


class Merger:
    """Merges by the column `arrival`.  Pure: the caller brings the time, in seconds."""

    def __init__(self, hold_s: float = DEFAULT_HOLD_S) -> None:
        self._hold_s = hold_s
        self._waiting: list[RecordBatch] = []
        self._reached: dict[str, int] = {}
        self._heard: dict[str, float] = {}
        self._released = -1
        self.twice = 0
        """Packets that came by more than one stream."""
        self.disordered = 0
        """Packets that came after later ones had been let go: they were left out."""

    def expect(self, streams: set[str], now: float) -> None:
        """These streams there are from now on."""
        self._heard = {name: self._heard.get(name, now) for name in streams}
        self._reached = {name: self._reached.get(name, -1) for name in streams}

    def put(self, stream: str, batch: RecordBatch, now: float) -> RecordBatch | None:
        """Take a batch of a stream; returns what can be let go."""
        if len(batch):
            self._heard[stream] = now
            self._reached[stream] = max(self._reached.get(stream, -1), int(batch["arrival"].max()))
            self._waiting.append(batch)
        return self.release(now)

    def release(self, now: float) -> RecordBatch | None:
        """What no stream can precede any more."""
        if not self._waiting:
            return None
        live = [self._reached[name] for name, heard in self._heard.items() if now - heard < self._hold_s]
        if sum(map(len, self._waiting)) > _MOST_ROWS:
            live = []
        return self._up_to(min(live) if live else None)

    def flush(self) -> RecordBatch | None:
        """All that waits."""
        return self._up_to(None) if self._waiting else None

    def _up_to(self, limit: int | None) -> RecordBatch | None:
        whole = _joined(self._waiting)
        arrival = whole["arrival"].astype(np.int64)
        order = np.argsort(arrival, kind="stable")
        ordered = arrival[order]
        fresh = ordered > self._released
        first = np.concatenate(([True], ordered[1:] != ordered[:-1]))
        self.twice += int((~first).sum())
        self.disordered += int((first & ~fresh).sum())
        ready = first & fresh
        if limit is None:
            self._waiting = []
        else:
            later = first & (ordered > limit)
            self._waiting = [whole.take(order[later])] if later.any() else []
            ready &= ordered <= limit
        chosen = order[ready]
        if not len(chosen):
            return None
        self._released = int(arrival[chosen[-1]])
        return whole.take(chosen)


def _joined(batches: list[RecordBatch]) -> RecordBatch:
    """One batch; columns that not all have are filled with zeros."""
    if len(batches) == 1:
        return batches[0]
    kinds = {name: batch[name].dtype for batch in batches for name in batch.columns}
    return RecordBatch(
        {
            name: np.concatenate(
                [batch[name] if name in batch else np.zeros(len(batch), dtype=kind) for batch in batches]
            )
            for name, kind in kinds.items()
        }
    )
