"""Writing under one concrete key: numbering, batching, and items that wait for an assignment.

    write ──► put ──► buffer ──cut──► sink([(frame, payload)], mode)    cut by bytes, by time, by NO_WAIT
                └──► big values: a frame of their own, copied once; those that follow each other closely
                     are handed over together, which saves a system call and a wake-up for each

Callers hold `lock`.  No I/O here: the sink does it.
"""

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from due.codec import Frame, encode_frame, encode_single, encode_value, freeze
from due.keys import Key
from due.membership import Permission, Verdict
from due.messages import RecordBatch
from due.pacing import Pacer

PUBLISH = 1
"""Mode bit: goes to Data Updates."""
ARCHIVE = 2
"""Mode bit: goes to Data Archives."""
BOTH = PUBLISH | ARCHIVE

Sent = tuple[Frame, bytes]
"""A frame, decoded and encoded."""
Sink = Callable[["KeyWriter", list[Sent], int], None]
Waiting = tuple[Any, int, bool, int | None, int]
"""(frozen value, mode, NO_WAIT, event time, timestamp)"""

_ITEM_OVERHEAD = 12
_CLOSELY_NS = 1_000_000


class KeyWriter:
    """The items of one (instance, key)."""

    def __init__(
        self,
        key: Key,
        app_id: str,
        instance_id: str,
        *,
        frame_bytes: int,
        single_bytes: int,
        sink: Sink,
        dirty: Callable[["KeyWriter"], None],
    ) -> None:
        self.key = key
        self.lock = threading.Lock()
        self.fast = False
        """`write` may call `put` directly; any thread may set it False, only the holder of `lock` True."""
        self.permission = Permission(Verdict.BUFFER)
        self.pacer: Pacer[Waiting] | None = None
        self.held: deque[Waiting] = deque()
        self.held_bytes = 0
        self.reliable = False
        self.index = False
        self.epoch = 0
        self.sequence = 0
        """Sequence number of the newest item, including buffered ones."""
        self.published = 0
        self.retired = False
        """Idle and removed; a successor continues its sequence numbers."""
        self.filled = 0
        """Frames that were sent because they were full."""
        self.queued, self.due, self.ticket = False, 0.0, 0  # kept by the sender thread
        self.stay, self.patience, self.filled_before = 0.0, 0.0, 0  # what it saw last
        self._identity = (key.text, app_id, instance_id)
        self._frame_bytes = frame_bytes
        self._single_bytes = single_bytes
        self._sink = sink
        self._dirty = dirty
        self._mode = BOTH
        self._size = 0
        self._values: list[Any] = []
        self._times: list[int] = []
        self._events: list[int] | None = None
        self._big: list[Sent] = []
        """Big values that wait; never at the same time as values in the buffer."""
        self._big_at = -_CLOSELY_NS

    @property
    def empty(self) -> bool:
        """Whether nothing waits here."""
        paced = self.pacer is not None and self.pacer.due() is not None
        return not (self._values or self._big or self.held or paced)

    @property
    def idle(self) -> bool:
        """Whether nothing waits here and no flush is scheduled."""
        return self.empty and not self.queued

    def retire(self) -> tuple[int, int] | None:
        """Remove it if it is idle; returns the numbers with which its successor starts."""
        if not self.lock.acquire(blocking=False):
            return None
        try:
            if not self.idle:
                return None
            self.retired, self.fast = True, False
            return self.sequence, self.published
        finally:
            self.lock.release()

    def dirty(self) -> None:
        """Schedule a flush by the sender thread."""
        self._dirty(self)

    def put(self, value: Any, mode: int, event_time: int | None, now: int, *, stays: bool = True) -> None:
        """Number one item and buffer it, or send it now if it is big; raises `UnsupportedValue`.

        `stays`: the caller does not `cut` at once, so somebody else will have to.
        """
        if type(value) is bytes:
            size = len(value)
        else:
            value, size = self._sized(value)
        if size >= self._single_bytes:
            self._put_single(value, mode, event_time, now, stays=stays)
            return
        if mode != self._mode or self._big:
            self.cut()
            self._mode = mode
        first = not self._values
        self.sequence += 1
        self._values.append(value)
        self._times.append(now)
        if self._events is not None:
            self._events.append(now if event_time is None else event_time)
        elif event_time is not None:
            self._events = [*self._times[:-1], event_time]
        self._size += size + _ITEM_OVERHEAD
        if self._size >= self._frame_bytes:
            self.filled += 1
            self.cut()
        elif first and stays:
            self._dirty(self)

    def cut(self) -> None:
        """Send what is buffered as one frame, or the big values that wait."""
        if self._big:
            big, self._big, self._size = self._big, [], 0
            self._sink(self, big, self._mode)
            return
        values = self._values
        if not values:
            return
        count = len(values)
        frame = self._head(self.sequence - count + 1, self._times, self._events, self._mode, count)
        frame.values = values
        self._values, self._times, self._events, self._size = [], [], None, 0
        self._sink(self, [(frame, encode_frame(frame))], self._mode)

    def _put_single(self, value: Any, mode: int, event_time: int | None, now: int, *, stays: bool) -> None:
        if self._values or mode != self._mode:
            self.cut()
            self._mode = mode
        events = None if event_time is None else [event_time]
        published = self.published
        head = self._head(self.sequence + 1, [now], events, mode, 1)
        try:
            payload = encode_single(head, value)
        except Exception:
            self.published = published
            raise
        self.sequence += 1
        closely, self._big_at = now - self._big_at < _CLOSELY_NS, now
        self._big.append((head, payload))
        self._size += len(payload)
        if not (stays and closely) or self.reliable or self._size >= self._frame_bytes:
            self.filled += closely
            self.cut()
        elif len(self._big) == 1:
            self._dirty(self)

    def _head(
        self, sequence: int, times: list[int], events: list[int] | None, mode: int, count: int
    ) -> Frame:
        before = self.published
        if mode & PUBLISH:
            self.published += count
        return Frame(*self._identity, self.epoch, sequence, before, times, events, [])

    def _sized(self, value: Any) -> tuple[Any, int]:
        kind = type(value)
        if kind is RecordBatch:
            return value, self._single_bytes
        if kind is np.ndarray and value.nbytes >= self._single_bytes:
            return value, value.nbytes
        if kind in (int, float, bool, type(None)):
            return freeze(value), 9
        if kind is str:
            return freeze(value), len(value)
        encoded = encode_value(value)
        return msgspec.Raw(encoded), len(encoded)
