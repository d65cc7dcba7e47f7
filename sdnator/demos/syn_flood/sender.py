"""Sends the frames of a flood at their times: sendmmsg, many frames a call, no copy in Python.

Linux; a raw socket needs root.
"""

import ctypes
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from sdnator.demos.syn_flood.frames import Bytes, FloodFrames

_BURST_S: Final = 0.002
_MOST: Final = 256
"""Frames a call."""
_POINTER: Final = ctypes.sizeof(ctypes.c_void_p)
_TALLY_S: Final = 0.1


class _Piece(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Message(ctypes.Structure):
    """struct msghdr of Linux."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("pieces", ctypes.c_void_p),
        ("piece_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Header(ctypes.Structure):
    """struct mmsghdr."""

    _fields_ = (("message", _Message), ("sent", ctypes.c_uint))


class FrameBatch:
    """Frames laid out for sendmmsg."""

    def __init__(self, frames: Bytes) -> None:
        self._frames = np.ascontiguousarray(frames)
        count, length = self._frames.shape
        self._pieces = (_Piece * count)()
        self._headers = (_Header * count)()
        places = self._frames.ctypes.data + np.arange(count, dtype=np.uint64) * np.uint64(length)
        pieces = np.frombuffer(self._pieces, np.uint64).reshape(count, -1)
        pieces[:, 0], pieces[:, 1] = places, length
        first = ctypes.addressof(self._pieces)
        headers = np.frombuffer(self._headers, np.uint64).reshape(count, -1)
        headers[:, _Message.pieces.offset // _POINTER] = first + np.arange(
            count, dtype=np.uint64
        ) * np.uint64(ctypes.sizeof(_Piece))
        headers[:, _Message.piece_count.offset // _POINTER] = 1
        self._address = ctypes.addressof(self._headers)
        self._call = ctypes.CDLL(None, use_errno=True).sendmmsg
        self._call.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int)

    def send(self, descriptor: int, begin: int, end: int) -> int:
        """Send frames [begin, end); how many went, 0 where the first of them was refused."""
        address = self._address + begin * ctypes.sizeof(_Header)
        return max(0, int(self._call(descriptor, address, end - begin, 0)))


@dataclass
class FloodReport:
    """What a flood did; wall times."""

    first: float = 0.0
    sent: int = 0
    failed: int = 0
    seconds: float = 0.0
    latest_ms: float = 0.0
    """How late a frame was at most."""
    tally: list[tuple[float, int]] = field(default_factory=list)
    """Wall time, and frames sent since the last one."""

    def to_json(self) -> dict[str, Any]:
        return dict(self.__dict__)


def _never() -> bool:
    return False


def send_flood(
    wire: socket.socket,
    flood: FloodFrames,
    begun: Callable[[float], None],
    enough: Callable[[], bool] = _never,
) -> FloodReport:
    """Send all frames, each at its time or as soon after as can be; `begun` is told the wall time.

    `enough` is asked now and then whether to end.
    """
    batch, due = FrameBatch(flood.frames), flood.due
    report = FloodReport(first=time.time())
    start = time.monotonic()
    begun(report.first)
    place, tallied, told = 0, 0, start
    while place < len(due):
        now = time.monotonic()
        end = int(np.searchsorted(due, now - start, side="right"))
        if end > place:
            report.latest_ms = max(report.latest_ms, (now - start - float(due[place])) * 1000)
        place = _send_until(batch, wire.fileno(), place, end, report)
        if now - told >= _TALLY_S or place == len(due):
            report.tally.append((time.time(), place - tallied))
            tallied, told = place, now
            if enough():
                break
        time.sleep(_pause(due, place, time.monotonic() - start))
    report.seconds = time.monotonic() - start
    return report


def _send_until(batch: FrameBatch, descriptor: int, place: int, end: int, report: FloodReport) -> int:
    while place < end:
        went = batch.send(descriptor, place, min(end, place + _MOST))
        report.sent += went
        report.failed += went == 0  # the interface's queue is full: that frame is lost
        place += went or 1
    return place


def _pause(due: npt.NDArray[np.float64], place: int, since: float) -> float:
    """Until the next frame, and no shorter than a burst is apart from the next."""
    if place == len(due):
        return 0.0
    return max(0.0, min(1.0, max(_BURST_S, float(due[place]) - since)))
