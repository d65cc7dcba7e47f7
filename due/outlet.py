"""What one engine writes under one concrete key: numbering, batching, and what waits for permission.

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
"""What stands in a frame, and the frame as it travels."""
Sink = Callable[["Outlet", list[Sent], int], None]
Waiting = tuple[Any, int, bool, int | None, int]
"""(frozen value, mode, NO_WAIT, event time, timestamp)"""

_ITEM_OVERHEAD = 12
_CLOSELY_NS = 1_000_000


class Outlet:
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
        dirty: Callable[["Outlet"], None],
    ) -> None:
        self.key = key
        self.lock = threading.Lock()
        self.fast = False
        """Nothing stands between `write` and `put`; anyone may set it False, only the holder of `lock` True."""
        self.permission = Permission(Verdict.BUFFER)
        self.pacer: Pacer[Waiting] | None = None
        self.held: deque[Waiting] = deque()
        self.held_bytes = 0
        self.reliable = False
        self.index = False
        self.epoch = 0
        self.sequence = 0
        """Of the newest item; items in the buffer have theirs already."""
        self.published = 0
        self.retired = False
        """Idle and put away: its numbers live on in its successor."""
        self.filled = 0
        """Frames that were sent because they were full."""
        self.queued, self.due, self.ticket = False, 0.0, 0  # the sender's notes
        self.stay, self.patience, self.filled_before = 0.0, 0.0, 0  # and what it has seen
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
        """Never together with values in the buffer."""
        self._big_at = -_CLOSELY_NS

    @property
    def empty(self) -> bool:
        """Whether nothing waits here."""
        paced = self.pacer is not None and self.pacer.due() is not None
        return not (self._values or self._big or self.held or paced)

    @property
    def idle(self) -> bool:
        """Whether nothing waits here, and no visit of the sender is planned."""
        return self.empty and not self.queued

    def retire(self) -> tuple[int, int] | None:
        """Put it away if it is idle and nobody is writing: the numbers its successor begins with."""
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
        """Ask for a visit of the sender."""
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
