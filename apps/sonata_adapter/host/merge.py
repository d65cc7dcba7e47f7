"""Several streams of one switch's packets → one stream in the order of arrival, each packet once.

The controller publishes copies under one key for each condition; a packet that meets two
conditions arrives twice.  Packets wait until every stream has reached their number, or until nothing arrived for
a tenth of a second of the caller's clock; streams that stay silent while others are busy are not
waited for.  The waits are shorter if results are due sooner: `patience`.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from due import RecordBatch

DEFAULT_HOLD_S: Final = 0.1
LONGEST_WAIT_S: Final = 1.0
SHORTEST_WAIT_S: Final = 0.04
"""Time for one batch in the controller and one in DUE on a busy machine, seconds."""
_MOST_ROWS: Final = 1 << 18
_REMEMBERED: Final = 1 << 20
_TURNS: Final = 64
"""A stream is silent after this many batches of others, and a second, without one of its own."""
_SHARE: Final = 4
"""One in this many parts of the shortest window may be spent waiting for silent streams."""


def patience(window_us: int | None) -> float:
    """Seconds to wait for silent streams, given the shortest window in force."""
    if window_us is None:
        return LONGEST_WAIT_S
    return min(LONGEST_WAIT_S, max(SHORTEST_WAIT_S, window_us / 1e6 / _SHARE))


class _Stream:
    """The progress of one stream."""

    def __init__(self) -> None:
        self.arrival = -1
        self.time_us: int | None = None
        self.turn = 0
        self.heard: float | None = None


class _Waiting(NamedTuple):
    first: int
    """Lowest arrival number."""
    batch: RecordBatch


class Merger:
    """Merges by the column `arrival`.  Pure: the caller brings the time, in seconds."""

    def __init__(self) -> None:
        self._hold_s = DEFAULT_HOLD_S
        self._wait_s = LONGEST_WAIT_S
        self._silent_turns = _TURNS
        self._waiting: list[_Waiting] = []
        self._rows = 0
        self._streams: dict[str, _Stream] = {}
        self._turn = 0
        self._heard = 0.0
        self._newest_us: int | None = None
        self._released = -1
        self._numbers: NDArray[np.int64] | None = None
        self.twice = 0
        """Packets that arrived on more than one stream."""
        self.disordered = 0
        """Packets that were released after later ones."""

    def expect(self, names: set[str]) -> None:
        """Replace the set of streams."""
        self._streams = {name: self._streams.get(name) or _Stream() for name in names}

    def hurry(self, wait_s: float) -> None:
        """Set the longest wait for a silent stream, seconds; see `patience`."""
        self._wait_s = wait_s
        self._hold_s = min(DEFAULT_HOLD_S, wait_s)
        self._silent_turns = max(1, round(_TURNS * wait_s / LONGEST_WAIT_S))

    def put(self, name: str, batch: RecordBatch, now: float) -> RecordBatch | None:
        """Add a batch of a stream; returns the packets that can be released."""
        self._heard = now
        self._turn += 1
        for stream in self._streams.values():
            stream.heard = now if stream.heard is None else stream.heard
        if len(batch):
            stream = self._streams.setdefault(name, _Stream())
            stream.arrival = int(batch["arrival"].max())
            stream.time_us = int(batch["time_us"].max())
            stream.turn, stream.heard = self._turn, now
            self._newest_us = max(stream.time_us, self._newest_us or stream.time_us)
            self._wait(batch)
        return self.release(now)

    def horizon_us(self, now: float) -> int | None:
        """Capture time that all streams but silent ones have reached; None: unknown."""
        if now - self._heard >= self._hold_s:
            return self._newest_us
        times = [stream.time_us for stream in self._streams.values() if not self._is_silent(stream, now)]
        known = [time_us for time_us in times if time_us is not None]
        return min(known) if known and len(known) == len(times) else None

    def _is_silent(self, stream: _Stream, now: float) -> bool:
        waited = 0.0 if stream.heard is None else now - stream.heard
        return self._turn - stream.turn >= self._silent_turns and waited >= self._wait_s

    def busy(self, now: float) -> None:
        """Note that the caller could not add batches until `now`."""
        self._heard = max(now, self._heard)

    def release(self, now: float) -> RecordBatch | None:
        """Release packets that no stream can precede any more or that have waited long enough."""
        if not self._waiting:
            return None
        if now - self._heard >= self._hold_s or self._rows > _MOST_ROWS:
            return self._up_to(None)
        live = [stream.arrival for stream in self._streams.values() if not self._is_silent(stream, now)]
        return self._up_to(min(live) if live else None)

    def is_quiet(self, now: float) -> bool:
        """Whether nothing waits, and nothing has arrived for so long that nothing is expected."""
        return not self._waiting and now - self._heard >= self._wait_s

    def set_back(self) -> RecordBatch | None:
        """The clock was set back: release all waiting packets, and forget how far the streams have come."""
        released = self.flush()
        self._newest_us = None
        for stream in self._streams.values():
            stream.time_us = None
        return released

    def flush(self) -> RecordBatch | None:
        """Release all waiting packets."""
        return self._up_to(None) if self._waiting else None

    def _wait(self, batch: RecordBatch) -> None:
        self._waiting.append(_Waiting(int(batch["arrival"].min()), batch))
        self._rows += len(batch)

    def _up_to(self, limit: int | None) -> RecordBatch | None:
        # batches that are entirely too new are not touched: there may be many, and this runs for each
        ripe = [each.batch for each in self._waiting if limit is None or each.first <= limit]
        if not ripe:
            return None
        self._waiting = [each for each in self._waiting if limit is not None and each.first > limit]
        whole = _joined(ripe)
        self._rows -= len(whole)
        order = np.argsort(whole["arrival"], kind="stable")
        ordered = whole["arrival"][order].astype(np.int64)
        ready = np.full(len(ordered), True) if limit is None else ordered <= limit
        if not ready.all():
            self._wait(whole.take(order[~ready]))
        order, ordered = order[ready], ordered[ready]
        place = ordered & (_REMEMBERED - 1)
        seen = self._seen
        fresh = np.concatenate(([True], ordered[1:] != ordered[:-1])) & (seen[place] != ordered)
        self.twice += int((~fresh).sum())
        order, ordered = order[fresh], ordered[fresh]
        if not len(order):
            return None
        seen[place[fresh]] = ordered
        self.disordered += int((ordered < self._released).sum())
        self._released = max(self._released, int(ordered[-1]))
        return whole.take(order)

    @property
    def _seen(self) -> NDArray[np.int64]:
        """The last numbers that were released; 8 MiB, which a switch without such packets does not need."""
        if self._numbers is None:
            self._numbers = np.full(_REMEMBERED, -1, dtype=np.int64)
        return self._numbers


def _joined(batches: list[RecordBatch]) -> RecordBatch:
    """Join batches; missing columns are filled with zeros."""
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
