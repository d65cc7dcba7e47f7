"""What waits to be sent to controllers: one Stream per StreamChannel, one PacketQueue per role.

    packet loop ── put ──► PacketQueue of the role ─┐
                                                    ├─ Stream.send() ──► gRPC
    arbitration, errors ── post ──► Stream ─────────┘

A queue belongs to its role, not to a stream: what a primary had not been sent when it left goes to the
next one.  Messages are protobuf bytes, ready to send.  `put`, `post`, `end` and `wake` are for any thread,
`send` for an event loop.
"""

import asyncio
import threading
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from typing import Any

from dataplane.p4runtime.status import Refused

_TAKE = 64
_UNIT = 2048
_BEYOND = 4
_MAX_CONTROL = 4096

Write = Callable[[bytes], Awaitable[Any]]


class PacketQueue:
    """Packet-ins and digest lists of one role, bounded by what `room` says.

    capacity: packet-ins; a long digest list counts for as many as it has `_UNIT` bytes
    on_room: called (where a stream is sent) when a queue that was full has room again
    """

    def __init__(self, capacity: int, on_room: Callable[[], None]) -> None:
        self._capacity = capacity
        self._on_room = on_room
        self._items: deque[bytes] = deque()
        self._weight = 0
        self._lock = threading.Lock()
        self._stalled = False
        self.reader: ControllerStream | None = None

    def __len__(self) -> int:
        return len(self._items)

    def room(self) -> int:
        """Packet-ins that can be put; 0 asks for `on_room` later."""
        with self._lock:
            room = self._capacity - self._weight
            self._stalled = room <= 0
            return max(0, room)

    def put(self, messages: Sequence[bytes], *, lossless: bool = False) -> int:
        """Append what there is room for; the number of messages that were refused.

        lossless: the caller has looked at `room`, and may go beyond it for the frames in its hands
        """
        with self._lock:
            limit = self._capacity * (_BEYOND if lossless else 1)
            taken = 0
            for message in messages:
                if self._weight >= limit:
                    break
                self._weight += _weight(message)
                taken += 1
            self._items.extend(messages[:taken])
        reader = self.reader
        if reader is not None:
            reader.wake()
        return len(messages) - taken

    def take(self) -> list[bytes]:
        """Some messages from the front."""
        with self._lock:
            items = self._items
            taken = [items.popleft() for _ in range(min(_TAKE, len(items)))]
            self._weight -= sum(map(_weight, taken))
            announce = self._stalled and self._weight <= self._capacity // 2
            if announce:
                self._stalled = False
        if announce:
            self._on_room()
        return taken

    def give_back(self, messages: list[bytes]) -> None:
        """Messages that were taken and not sent go to the front again."""
        with self._lock:
            self._items.extendleft(reversed(messages))
            self._weight += sum(map(_weight, messages))

    def clear(self) -> int:
        """Drop everything; the number of messages dropped."""
        with self._lock:
            dropped = len(self._items)
            self._items.clear()
            self._weight = 0
            self._stalled = False
        self._on_room()
        return dropped


def _weight(message: bytes) -> int:
    return 1 + len(message) // _UNIT


class ControllerStream:
    """One StreamChannel: its own messages, and the queue of its role while it is primary."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.queue: PacketQueue | None = None
        self.error: Refused | None = None
        self.dropped = 0
        self._control: deque[bytes] = deque()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ready = asyncio.Event()
        self._sleeping = False
        self._ended = False

    def post(self, message: bytes) -> None:
        """Send a message of this stream's own, ahead of what is queued."""
        if len(self._control) >= _MAX_CONTROL:
            self.dropped += 1
            return
        self._control.append(message)
        self.wake()

    def end(self, error: Refused | None = None) -> None:
        """End the stream, with an error status or without."""
        if not self._ended:
            self.error = error
            self._ended = True
        self.wake()

    def wake(self) -> None:
        """Something may be there to send; from any thread."""
        if self._sleeping and self._loop is not None:
            self._sleeping = False
            with suppress(RuntimeError):  # the event loop has ended meanwhile
                self._loop.call_soon_threadsafe(self._ready.set)

    async def send(self, write: Write) -> None:
        """Everything to be sent, one message after the other, until the stream ends."""
        self._loop = asyncio.get_running_loop()
        while True:
            queue, batch = await self._next()
            if not batch:
                return
            position = 0
            try:
                for message in batch:
                    position += 1
                    await write(message)
            finally:
                if queue is not None and position < len(batch):
                    queue.give_back(batch[position:])

    async def _next(self) -> tuple[PacketQueue | None, list[bytes]]:
        while True:
            # set before looking: a thread that adds something later sees it and wakes us
            self._sleeping = True
            found = self._look()
            if found is not None:
                self._sleeping = False
                return found
            await self._ready.wait()
            self._ready.clear()

    def _look(self) -> tuple[PacketQueue | None, list[bytes]] | None:
        if self._control:
            return None, [self._control.popleft() for _ in range(len(self._control))]
        if self._ended:
            return None, []
        queue = self.queue
        if queue is not None and len(queue):
            taken = queue.take()
            if taken:
                return queue, taken
        return None
