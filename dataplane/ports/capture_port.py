"""A replay's way into the switch: frames with capture times over a Unix socket, verdicts back.

    CaptureFeed (the replay) ── blocks of frames ──► CapturePort (the switch)
                             ◄── one byte a frame ──

A block is a header `<4sII` (b"SDNF", frames, bytes of all frames), then three little-endian arrays
(times in µs as int64, lengths on the wire and captured lengths as uint32), then the captured bytes.
A verdict has bit 0 set where the frame made a packet-in, bit 1 where it left through a port.

Nothing is lost here: the switch reads only what its queues can take, and a slow switch blocks `send`.
"""

import contextlib
import os
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np

from dataplane.errors import DataplaneError
from dataplane.frame_block import FrameBlock
from dataplane.ports.port import Arrived, PortCounters, PortError, Wakeup

COPIED = 1
FORWARDED = 2

MAX_WIRE = 1 << 18
"""Bytes that a frame had on the wire: what was cut is padded to so many, whatever the feeder says."""
MAX_TIME_US = (2**63 - 1) // 1000
"""P4Runtime has 64 bits for ns."""
_MAGIC = b"SDNF"
_HEADER = struct.Struct("<4sII")
_PER_FRAME = 16
_BLOCK_FRAMES = 1024
_MAX_BLOCK_FRAMES = 1 << 16
_MAX_BLOCK_BYTES = 1 << 28
_CHUNK = 1 << 18
_VERDICTS_WAITING = 1 << 20
PATIENCE_S = 90.0
"""Seconds for which a feeder waits for a switch that reads nothing."""


class CapturePortError(DataplaneError):
    """The other end broke the protocol or went away."""


def pack_block(times_us: Sequence[int], wire_lengths: Sequence[int], frames: Sequence[bytes]) -> bytes:
    """One block; the three sequences have equal lengths."""
    return _packed(FrameBlock.of(times_us, wire_lengths, frames))


def _packed(block: FrameBlock) -> bytes:
    return b"".join(
        (
            _HEADER.pack(_MAGIC, len(block), len(block.data)),
            block.times_us.astype("<i8", copy=False).tobytes(),
            block.lengths.astype("<u4", copy=False).tobytes(),
            block.captured.astype("<u4", copy=False).tobytes(),
            block.data,
        )
    )


class BlockReader:
    """Takes bytes as they come, gives frames padded with zeros to their length on the wire.  Pure."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._blocks: deque[FrameBlock] = deque()
        self._taken = 0
        """Frames of the first block that were taken."""
        self._waiting = 0

    def feed(self, data: bytes | memoryview) -> None:
        """More bytes.  Raises CaptureError where they are no block."""
        self._bytes += data
        start = 0
        while len(self._bytes) - start >= _HEADER.size:
            magic, count, size = _HEADER.unpack_from(self._bytes, start)
            if magic != _MAGIC or count > _MAX_BLOCK_FRAMES or size > _MAX_BLOCK_BYTES:
                raise CapturePortError(
                    f"not a block of frames: header {bytes(self._bytes[start : start + 12])!r}"
                )
            end = start + _HEADER.size + _PER_FRAME * count + size
            if len(self._bytes) < end:
                break
            self._take(bytes(self._bytes[start + _HEADER.size : end]), count, size)
            start = end
        del self._bytes[:start]

    def _take(self, block: bytes, count: int, size: int) -> None:
        times = np.frombuffer(block, "<i8", count)
        wire = np.frombuffer(block, "<u4", count, 8 * count)
        captured = np.frombuffer(block, "<u4", count, 12 * count)
        if count and (times.min() < 0 or times.max() > MAX_TIME_US):
            raise CapturePortError(
                f"frames at {times.min()} to {times.max()} µs of the capture; the clock of the switch goes from 0 to"
                f" {MAX_TIME_US}"
            )
        if int(captured.sum(dtype=np.int64)) != size:
            raise CapturePortError("the frames' lengths do not add up to the block's")
        longest, total = int(wire.max(initial=0)), int(wire.sum(dtype=np.int64))
        if longest > MAX_WIRE or total > _MAX_BLOCK_BYTES:
            raise CapturePortError(
                f"frames of up to {longest} and together {total} bytes on the wire; at most {MAX_WIRE} and"
                f" {_MAX_BLOCK_BYTES} a block"
            )
        if count:
            found = FrameBlock(times, np.maximum(wire, captured), captured, block[_PER_FRAME * count :])
            self._blocks.append(found.padded())
            self._waiting += count

    def waiting(self) -> int:
        """Frames not taken yet."""
        return self._waiting

    def unfinished(self) -> int:
        """Bytes of a block that has not come in full."""
        return len(self._bytes)

    def take(self, limit: int) -> FrameBlock:
        """At most `limit` frames, in order: those of one block."""
        if not self._blocks or limit <= 0:
            return FrameBlock.of((), (), ())
        block, first = self._blocks[0], self._taken
        end = min(first + limit, len(block))
        if end == len(block):
            self._blocks.popleft()
            self._taken = 0
        else:
            self._taken = end
        self._waiting -= end - first
        return block.part(first, end)


class CapturePort:
    """The switch's end: listens on a Unix socket, serves one feeder after the other.

    path: of the socket; a stale one is replaced, one that answers is an error

    Raises PortError.
    """

    lossless = True

    def __init__(self, path: str) -> None:
        self.counters = PortCounters()
        self._path = Path(path)
        self._listener = _listen(self._path)
        self._feeder: socket.socket | None = None
        self._reader = BlockReader()
        # kept, because the allocator would map and unmap a new one for each read
        self._buffer = memoryview(bytearray(_CHUNK))
        self._verdicts = bytearray()
        self._ended = False

    def fileno(self) -> int:
        if self._feeder is None:
            return self._listener.fileno()
        return self._feeder.fileno()

    def waiting(self) -> bool:
        """Frames are here already, so that the socket need not become readable."""
        return self._reader.waiting() > 0

    def receive(self, limit: int) -> Arrived:
        if self._feeder is None:
            self._accept()
            return Arrived()
        if not self._ended and self._reader.waiting() < limit:
            self._read()
        if self._ended and not self._reader.waiting() and not self._verdicts:
            self._hang_up()
            return Arrived()
        if len(self._verdicts) > _VERDICTS_WAITING:
            return Arrived()
        block = self._reader.take(limit)
        self.counters.received += len(block)
        return Arrived(block=block)

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self._feeder, _ = self._listener.accept()
            self._feeder.setblocking(False)
            self._reader = BlockReader()
            self._verdicts.clear()
            self._ended = False

    def _read(self) -> None:
        assert self._feeder is not None  # noqa: S101 - receive() has seen to it
        try:
            size = self._feeder.recv_into(self._buffer)
            self._reader.feed(self._buffer[:size])
            self._ended = not size
        except BlockingIOError:
            return
        except (OSError, CapturePortError):
            # what came whole before is still processed
            self._ended = True

    def _hang_up(self) -> None:
        if self._reader.unfinished():
            self.counters.failed += 1
        if self._feeder is not None:
            self._feeder.close()
            self._feeder = None

    def send(self, frame: bytes) -> None:  # noqa: ARG002 - a capture takes nothing in
        self.counters.sent += 1

    def done(self, verdicts: bytes) -> None:
        self._verdicts += verdicts
        self.flush()

    def unsent(self) -> bool:
        return bool(self._verdicts) and self._feeder is not None

    def flush(self) -> None:
        if self._feeder is None or not self._verdicts:
            return
        try:
            sent = self._feeder.send(self._verdicts)
            del self._verdicts[:sent]
        except BlockingIOError:
            return
        except OSError:
            # nobody listens for verdicts any more; the frames are still processed
            self._verdicts.clear()

    def close(self) -> None:
        self._hang_up()
        self._listener.close()
        self._path.unlink(missing_ok=True)


def _listen(path: Path) -> socket.socket:
    if path.is_socket():
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            if probe.connect_ex(str(path)) == 0:
                raise PortError(f"capture port {path} is in use by another switch; choose another path")
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if path.is_socket():
            path.unlink()
        before = os.umask(0o177)  # nobody else connects, not even before a chmod
        try:
            listener.bind(str(path))
        finally:
            os.umask(before)
    except OSError as error:
        listener.close()
        raise PortError(f"capture port {path}: {error}; choose a short path in a writable folder") from error
    listener.listen(1)
    listener.setblocking(False)
    return listener


class CaptureFeed:
    """The replay's end of a capture port; one thread may send while another takes verdicts.

    >>> feed = CaptureFeed("/run/switch.sock")          # doctest: +SKIP
    >>> feed.send([0, 10], [60, 1500], [frame, cut])    # doctest: +SKIP
    >>> feed.verdicts()                                 # doctest: +SKIP
    b'\\x03\\x03'

    path: the switch's socket
    patience_s: seconds after which a switch that reads nothing has failed

    Raises CaptureError where nobody listens there.
    """

    def __init__(self, path: str, patience_s: float = PATIENCE_S) -> None:
        self._patience_s = patience_s
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.connect(path)
        except OSError as error:
            self._socket.close()
            raise CapturePortError(
                f"capture port {path}: {error.strerror}; is the switch running?"
            ) from error
        self._socket.setblocking(False)
        self._lock = threading.Lock()
        self._received = bytearray()
        self._buffer = memoryview(bytearray(_CHUNK))
        # verdicts that `send` took in while it waited leave the socket unreadable: the epoll shows both
        self._kept = Wakeup()
        self._epoll = select.epoll()
        self._epoll.register(self._socket.fileno(), select.EPOLLIN)
        self._epoll.register(self._kept.fileno(), select.EPOLLIN)

    def send(self, times_us: Sequence[int], wire_lengths: Sequence[int], frames: Sequence[bytes]) -> None:
        """Frames in order; blocks while the switch does not read, until the feeder's patience is over.

        times_us: µs since the capture's base second
        wire_lengths: bytes on the wire, at least what was captured
        frames: what was captured

        Raises CaptureError when the switch is gone.
        """
        for start in range(0, len(frames), _BLOCK_FRAMES):
            end = start + _BLOCK_FRAMES
            self.send_block(FrameBlock.of(times_us[start:end], wire_lengths[start:end], frames[start:end]))

    def send_block(self, block: FrameBlock) -> None:
        """Frames in order, at most 65,536 of up to 256 MiB; otherwise as `send`."""
        self._send(_packed(block))

    def _send(self, data: bytes) -> None:
        view, since = memoryview(data), time.monotonic()
        while view:
            # verdicts are read meanwhile: two ends that both wait to write would wait for ever
            readable, writable, _ = select.select([self._socket], [self._socket], [], self._patience_s)
            if not writable and time.monotonic() - since >= self._patience_s:
                raise CapturePortError(
                    f"the switch has read nothing from its capture port for {self._patience_s:.0f} s"
                )
            if readable:
                with self._lock:
                    self._receive()
                self._kept.set()
            if writable:
                try:
                    view, since = view[self._socket.send(view) :], time.monotonic()
                except BlockingIOError:
                    continue
                except OSError as error:
                    raise CapturePortError(f"the switch closed its capture port: {error.strerror}") from error

    def _receive(self) -> None:
        try:
            size = self._socket.recv_into(self._buffer)
        except BlockingIOError:
            return
        except OSError as error:
            raise CapturePortError(f"the switch closed its capture port: {error.strerror}") from error
        if not size:
            raise CapturePortError("the switch closed its capture port")
        self._received += self._buffer[:size]

    def verdicts(self) -> bytes:
        """The verdicts that arrived since the last call, without waiting.

        Raises CaptureError when the switch is gone and none are left.
        """
        with self._lock:
            self._kept.clear()
            try:
                while select.select([self._socket], [], [], 0)[0]:
                    self._receive()
            except CapturePortError:
                if not self._received:
                    raise
            received = bytes(self._received)
            self._received.clear()
            return received

    def fileno(self) -> int:
        """Readable when verdicts wait, or the switch is gone."""
        return self._epoll.fileno()

    def close(self) -> None:
        """End the feed; frames that were sent are still processed."""
        self._epoll.close()
        self._kept.close()
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
