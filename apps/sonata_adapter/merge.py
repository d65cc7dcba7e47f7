"""Several streams of one switch's packets → one stream in the order of arrival, each packet once.

The controller publishes what it copies under one key for each condition; a packet that meets two
conditions comes twice.  Packets wait until every stream has come as far, until nothing has come for
`hold_s` of the caller's clock, or for `LONGEST_WAIT_S`.
"""

from typing import Final

import numpy as np

from due import RecordBatch

DEFAULT_HOLD_S: Final = 0.1
LONGEST_WAIT_S: Final = 1.0
_MOST_ROWS: Final = 1 << 18
_REMEMBERED: Final = 1 << 20


class Merger:
    """Merges by the column `arrival`.  Pure: the caller brings the time, in seconds."""

    def __init__(self, hold_s: float = DEFAULT_HOLD_S) -> None:
        self._hold_s = hold_s
        self._waiting: list[tuple[float, RecordBatch]] = []
        self._reached: dict[str, int] = {}
        self._heard = 0.0
        self._released = -1
        self._seen = np.full(_REMEMBERED, -1, dtype=np.int64)
        self.twice = 0
        """Packets that came by more than one stream."""
        self.disordered = 0
        """Packets that were let go after later ones."""

    def expect(self, streams: set[str]) -> None:
        """These streams there are from now on."""
        self._reached = {name: self._reached.get(name, -1) for name in streams}

    def put(self, stream: str, batch: RecordBatch, now: float) -> RecordBatch | None:
        """Take a batch of a stream; returns what can be let go."""
        self._heard = now
        if len(batch):
            if stream in self._reached:
                self._reached[stream] = int(batch["arrival"].max())
            self._waiting.append((now, batch))
        return self.release(now)

    def busy(self, now: float) -> None:
        """Until `now` the caller had no time to bring more."""
        self._heard = max(now, self._heard)

    def release(self, now: float) -> RecordBatch | None:
        """What no stream can precede any more, and what has waited long enough."""
        if not self._waiting:
            return None
        rows = sum(len(batch) for _, batch in self._waiting)
        if now - self._heard >= self._hold_s or not self._reached or rows > _MOST_ROWS:
            return self._up_to(None)
        limit = min(self._reached.values())
        for since, batch in self._waiting:
            if now - since >= LONGEST_WAIT_S:
                limit = max(limit, int(batch["arrival"].max()))
        return self._up_to(limit)

    def flush(self) -> RecordBatch | None:
        """All that waits."""
        return self._up_to(None) if self._waiting else None

    def _up_to(self, limit: int | None) -> RecordBatch | None:
        oldest = self._waiting[0][0]
        whole = _joined([batch for _, batch in self._waiting])
        order = np.argsort(whole["arrival"], kind="stable")
        ordered = whole["arrival"][order].astype(np.int64)
        ready = np.full(len(ordered), True) if limit is None else ordered <= limit
        self._waiting = [] if ready.all() else [(oldest, whole.take(order[~ready]))]
        order, ordered = order[ready], ordered[ready]
        if not len(order):
            return None
        place = ordered & (_REMEMBERED - 1)
        fresh = np.concatenate(([True], ordered[1:] != ordered[:-1])) & (self._seen[place] != ordered)
        self.twice += int((~fresh).sum())
        order, ordered = order[fresh], ordered[fresh]
        if not len(order):
            return None
        self._seen[place[fresh]] = ordered
        self.disordered += int((ordered < self._released).sum())
        self._released = max(self._released, int(ordered[-1]))
        return whole.take(order)


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
