"""Ports of the embedded switch: where frames come from and go to.

Port ── receive(limit) ──► packet loop ── send(frame) ──► Port
  ├── NullPort       nothing arrives; what is sent is counted
  ├── MemoryPort     in-process, for tests
  ├── PcapPort       (pcap_port.py) capture files in and out
  ├── VethPort       (veth_port.py) AF_PACKET on a real interface, needs root
  └── CapturePort    (capture_port.py) frames of a replay over a Unix socket, with verdicts

DataplaneError
└── PortError        a port that cannot be opened
"""

import os
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from dataplane.errors import DataplaneError
from dataplane.frame_block import FrameBlock

MAX_FRAME = 9216


class PortError(DataplaneError):
    """A port that cannot be opened or was described wrongly."""


@dataclass(slots=True)
class PortCounters:
    """What passed a port, in frames; every frame that came or went is in one of them."""

    received: int = 0
    sent: int = 0
    oversized: int = 0
    failed: int = 0


@dataclass(slots=True)
class Arrived:
    """Frames in the order of their arrival.

    times_us: µs of the capture, one per frame; empty = stamp them with the switch's clock
    block: frames end to end, in place of the other two; without a capture their times say nothing
    """

    frames: Sequence[bytes] = ()
    times_us: Sequence[int] = ()
    block: FrameBlock | None = None

    def __len__(self) -> int:
        return len(self.frames) if self.block is None else len(self.block)


class Port(Protocol):
    """What the packet loop asks of a port.

    lossless: frames wait in the port while the controller's queue has no room; elsewhere the frames are
        processed and their packet-ins are dropped and counted
    """

    lossless: bool
    counters: PortCounters

    def fileno(self) -> int:
        """Readable when frames wait; -1 = never.  May change after `receive`."""
        ...

    def waiting(self) -> bool:
        """Frames can be received although `fileno` need not be readable."""
        ...

    def receive(self, limit: int) -> Arrived:
        """At most `limit` frames, without waiting."""
        ...

    def send(self, frame: bytes) -> None:
        """Send a frame; one that cannot be sent is counted."""
        ...

    def done(self, verdicts: bytes) -> None:
        """The frames of the last `receive` were processed; one byte each (see Result.verdicts)."""
        ...

    def unsent(self) -> bool:
        """Answers wait until `fileno` is writable; then `flush` is to be called."""
        ...

    def flush(self) -> None:
        """Send what waits, as far as it goes."""
        ...

    def close(self) -> None:
        """Release what the port holds."""
        ...


class Unanswering:
    """Mixed into ports whose frames need no answer."""

    def done(self, verdicts: bytes) -> None:
        """Nobody waits for them."""

    def unsent(self) -> bool:
        return False

    def flush(self) -> None:
        """Nothing waits."""


@dataclass
class NullPort(Unanswering):
    """A port that nothing is plugged into."""

    lossless: bool = False
    counters: PortCounters = field(default_factory=PortCounters)

    def fileno(self) -> int:
        return -1

    def waiting(self) -> bool:
        return False

    def receive(self, limit: int) -> Arrived:  # noqa: ARG002 - the protocol's shape
        return Arrived()

    def send(self, frame: bytes) -> None:  # noqa: ARG002
        self.counters.sent += 1

    def close(self) -> None:
        """Nothing is held."""


class Wakeup:
    """A file descriptor that is readable after `set` until `clear`."""

    def __init__(self) -> None:
        self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def fileno(self) -> int:
        return self._fd

    def set(self) -> None:
        if self._fd >= 0:
            os.eventfd_write(self._fd, 1)

    def clear(self) -> None:
        try:
            os.eventfd_read(self._fd)
        except BlockingIOError:
            return

    def close(self) -> None:
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)


class MemoryPort(Unanswering):
    """An in-process port: `inject` from any thread, read what was sent from `outgoing`.

    lossless: as in Port
    """

    def __init__(self, *, lossless: bool = False) -> None:
        self.lossless = lossless
        self.counters = PortCounters()
        self.outgoing: deque[bytes] = deque()
        self.verdicts = bytearray()
        self._incoming: deque[tuple[int | None, bytes]] = deque()
        self._ready = Wakeup()

    def inject(self, *frames: bytes, time_us: int | None = None) -> None:
        """Frames that arrive; with `time_us`, at that moment of the packets' clock."""
        self._incoming.extend((time_us, frame) for frame in frames)
        self._ready.set()

    def fileno(self) -> int:
        return self._ready.fileno()

    def waiting(self) -> bool:
        return bool(self._incoming)

    def receive(self, limit: int) -> Arrived:
        self._ready.clear()
        # injected after this line sets it again
        taken = [self._incoming.popleft() for _ in range(min(limit, len(self._incoming)))]
        self.counters.received += len(taken)
        times = [time for time, _ in taken if time is not None]
        return Arrived([frame for _, frame in taken], times if len(times) == len(taken) else ())

    def send(self, frame: bytes) -> None:
        self.counters.sent += 1
        self.outgoing.append(frame)

    def done(self, verdicts: bytes) -> None:
        self.verdicts += verdicts

    def close(self) -> None:
        self._ready.close()
