"""Numbered frames through the switch: what came, what came late, and which blocked sources came through.

The same frames also go through a program that only copies them from one interface to another, and that no fault
hits (`python -m benchmarks.chaos_frames IN OUT`): what it misses, the machine has missed, not the switch.
Frames are timed by the kernel as they arrive, so that a busy reader makes none late.
"""

import ipaddress
import random
import select
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable

from benchmarks.chaos_checker import Passed, gap_ms

INTERVAL_S = 0.004
LATE_S = 0.5
"""A frame that comes later than this was not forwarded in time; less is the scheduling of a busy machine."""
_MAGIC = b"sdnator-chaos"
_NUMBER = struct.Struct("!13sBQd")
_HEAD = 42
_FREE_SOURCES = 40
_TIMESTAMP = 35
"""SO_TIMESTAMPNS of Linux, which Python does not name."""
_EVERY = 3
"""ETH_P_ALL: a socket that asks for it before it is bound gets frames of all interfaces."""
_STAMP = struct.Struct("@qq")


def frame(source: str, kind: int, number: int, at: float) -> bytes:
    """Ethernet, IPv4 and UDP around a number; kind 0 is to pass, 1 comes from a source that is blocked."""
    body = _NUMBER.pack(_MAGIC, kind, number, at)
    mac = b"\x02\x00" + ipaddress.IPv4Address(source).packed
    udp = struct.pack("!HHHH", 40_000, 9, 8 + len(body), 0)
    address = ipaddress.IPv4Address(source).packed + bytes((10, 99, 0, 1))
    head = struct.pack("!BBHHHBBH", 0x45, 0, 28 + len(body), number & 0xFFFF, 0, 64, 17, 0) + address
    total = sum(struct.unpack("!10H", head))
    total = (total & 0xFFFF) + (total >> 16)
    checksum = ~((total & 0xFFFF) + (total >> 16)) & 0xFFFF
    head = head[:10] + struct.pack("!H", checksum) + head[12:]
    return b"\x02\x00\x00\x00\x00\x01" + mac + b"\x08\x00" + head + udp + body


class ForwardingProbe:
    """Sends into one end and listens at the other, each in a thread.

    Args:
        entry: interface that leads into the switch.
        leave: interface that the switch sends to.
        blocked: addresses that are blocked now.
    """

    def __init__(self, entry: str, leave: str, blocked: Callable[[], list[str]]) -> None:
        self._blocked = blocked
        self._ended = threading.Event()
        self._in, self._out = _open(entry), _open(leave)
        self.sent: list[float] = []
        self.came: dict[int, float] = {}
        """Delay of each number that came, s."""
        self.passed: list[Passed] = []
        self._threads = [threading.Thread(target=each, daemon=True) for each in (self._send, self._receive)]

    def start(self) -> None:
        for each in self._threads:
            each.start()

    def close(self) -> None:
        """Stop sending, hear what is still on its way."""
        self._ended.set()
        for each in self._threads:
            each.join()
        self._in.close()
        self._out.close()

    def gaps(self, late_s: float = LATE_S) -> list[tuple[float, float]]:
        """(when, ms) of each run of frames that were lost, or came later than `late_s`."""
        missed = [n for n in range(len(self.sent)) if n not in self.came or self.came[n] > late_s]
        return gap_ms(self.sent, missed)

    def _send(self) -> None:
        draw = random.Random(1)
        due = time.monotonic()
        while not self._ended.is_set():
            number, at = len(self.sent), time.monotonic()
            self.sent.append(at)
            self._put(frame(f"10.99.1.{1 + number % _FREE_SOURCES}", 0, number, at))
            blocked = self._blocked()
            if blocked and number % 10 == 0:
                source = draw.choice(blocked)
                self._put(frame(source, 1, int(ipaddress.IPv4Address(source)), at))
            due = max(due + INTERVAL_S, at)
            time.sleep(max(0.0, due - time.monotonic()))

    def _put(self, data: bytes) -> None:
        try:
            self._in.send(data)
        except OSError:
            # a full queue of the interface: the frame is missed, as it would be on a cable
            time.sleep(INTERVAL_S)

    def _receive(self) -> None:
        quiet_until = float("inf")
        while time.monotonic() < quiet_until:
            if self._ended.is_set() and quiet_until == float("inf"):
                quiet_until = time.monotonic() + 2 * LATE_S
            if select.select([self._out], [], [], 0.1)[0]:
                data, ancillary, _, _ = self._out.recvmsg(2048, 64)
                self._note(data, _arrival(ancillary))

    def _note(self, data: bytes, now: float) -> None:
        if len(data) < _HEAD + _NUMBER.size:
            return
        magic, kind, number, at = _NUMBER.unpack_from(data, _HEAD)
        if magic != _MAGIC:
            return
        if kind:
            self.passed.append(Passed(at, str(ipaddress.IPv4Address(number))))
        else:
            self.came.setdefault(number, now - at)


def _arrival(ancillary: list[tuple[int, int, bytes]]) -> float:
    """When the kernel had the frame, s, monotonic."""
    now = time.monotonic()
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, _TIMESTAMP):
            seconds, nanoseconds = _STAMP.unpack_from(data)
            waited: float = time.time() - seconds - nanoseconds / 1e9
            return now - max(0.0, waited)
    return now


def copy(entry: str, leave: str) -> None:
    """Send what comes in at one interface out at the other, for ever."""
    source, sink = _open(entry), _open(leave)
    while True:
        data, origin = source.recvfrom(16_384)
        if origin[2] != socket.PACKET_OUTGOING:
            sink.send(data)


def _open(interface: str) -> socket.socket:
    opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    opened.setsockopt(socket.SOL_SOCKET, _TIMESTAMP, 1)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
    opened.bind((interface, _EVERY))
    return opened


if __name__ == "__main__":
    copy(*sys.argv[1:3])
