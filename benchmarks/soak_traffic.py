"""Benign traffic of an office through the switch, both ways, at a steady rate; each frame is numbered.

The number is an Ethernet trailer behind the packet: whatever the packet is, it comes through with it.
"""

import ipaddress
import queue
import select
import socket
import struct
import threading
import time
from collections.abc import Collection, Iterator

from benchmarks.decision_traffic.capture_writer import frames_in
from benchmarks.decision_traffic.networks import NETWORKS

LATE_S = 5.0
"""A frame that has not come after so long is missing."""
_NUMBER = struct.Struct("!4sI")
_MAGIC = b"soak"
_SLICE_S = 0.02
_AHEAD = 20_000
_HOURS = 24 * 365
_OUTGOING = 4
_EVERY = 3
"""ETH_P_ALL: a socket that asks for it before it is bound gets frames of all interfaces."""
_HEAD = 34


class OfficeLoad:
    """Sends into both ends of a wire through a switch and counts what comes out at the other one.

    Args:
        near: interface on the side of the office.
        far: interface on the side of the Internet.
        seed: of the traffic.
    """

    def __init__(self, near: str, far: str, seed: int) -> None:
        self.pps = 0.0
        """Frames a second, may be set at any time; 0: none."""
        self.sent = self.came = self.missed = self.stopped = 0
        self._pending: dict[int, tuple[float, bytes]] = {}
        self._blocked: Collection[str] = ()
        self._ended = threading.Event()
        self._ends = (_open(near), _open(far))
        self._ready: queue.Queue[tuple[int, bytes]] = queue.Queue(_AHEAD)
        self._extra: Iterator[tuple[int, bytes]] = iter(())
        self._network = NETWORKS["office"](seed)
        self._threads = [
            threading.Thread(target=each, daemon=True) for each in (self._make, self._send, self._receive)
        ]

    def start(self) -> None:
        """Begin; nothing is sent before `pps` is set."""
        for each in self._threads:
            each.start()

    def close(self) -> None:
        """End; what has not come by now is missing."""
        self.pps = 0.0
        self._ended.set()
        for each in self._threads:
            each.join()
        for end in self._ends:
            end.close()

    def insert(self, frames: Iterator[tuple[int, bytes]]) -> None:
        """Send other frames first, at the same rate, and go on with the office afterwards.

        Args:
            frames: of each the end that it is sent into (0: the office's), and its bytes.
        """
        self._extra = frames

    def look(self, blocked: Collection[str]) -> None:
        """Count frames that are overdue: as stopped where their source is, or was at the last look, blocked.

        Args:
            blocked: addresses and MACs.
        """
        known, self._blocked = {*self._blocked, *blocked}, blocked
        before = time.monotonic() - LATE_S
        for number, (at, head) in list(self._pending.items()):
            if at > before:
                break
            if self._pending.pop(number, None) is not None:
                if known.isdisjoint(_sources(head)):
                    self.missed += 1
                else:
                    self.stopped += 1

    def _make(self) -> None:
        for frame in self._frames():
            while not self._ended.is_set():
                try:
                    self._ready.put(frame, timeout=0.5)
                    break
                except queue.Full:
                    continue
            if self._ended.is_set():
                return

    def _frames(self) -> Iterator[tuple[int, bytes]]:
        uplink = self._network.uplink_port
        # office hours: the network begins at midnight
        for part in self._network.chunks(9 * 3600, _HOURS * 3600):
            for port, data in zip(part.columns["port"].tolist(), frames_in(part), strict=True):
                yield int(port == uplink), data

    def _send(self) -> None:
        due, owed = time.monotonic(), 0.0
        while not self._ended.is_set():
            now = time.monotonic()
            # what could not be sent for a second is given up: the rate is to be steady, without bursts
            owed = min(owed + self.pps * (now - due), max(self.pps, 1.0))
            due = now
            while owed >= 1.0 and not self._ended.is_set():
                self._put(*(next(self._extra, None) or self._ready.get()))
                owed -= 1.0
            time.sleep(_SLICE_S)

    def _put(self, side: int, data: bytes) -> None:
        number, self.sent = self.sent, self.sent + 1
        self._pending[number] = (time.monotonic(), data[:_HEAD])
        while not self._ended.is_set():
            try:
                self._ends[side].send(data + _NUMBER.pack(_MAGIC, number))
            except OSError:
                # a full queue of the interface
                time.sleep(0.001)
            else:
                return

    def _receive(self) -> None:
        while not self._ended.is_set():
            for end in select.select(self._ends, [], [], 0.1)[0]:
                data, origin = end.recvfrom(16_384)
                if origin[2] != _OUTGOING and len(data) > _NUMBER.size:
                    magic, number = _NUMBER.unpack_from(data, len(data) - _NUMBER.size)
                    if magic == _MAGIC and self._pending.pop(number, None) is not None:
                        self.came += 1


def _sources(head: bytes) -> set[str]:
    """MAC and IPv4 address of a frame's sender."""
    found = {head[6:12].hex(":")}
    if head[12:14] == b"\x08\x00":
        found.add(str(ipaddress.IPv4Address(head[26:30])))
    return found


def _open(interface: str) -> socket.socket:
    opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
    opened.bind((interface, _EVERY))
    return opened
