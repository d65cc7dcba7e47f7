"""Datagrams between the thread that receives them and the one that decodes: bounded in number and in bytes."""

import threading
from collections import deque
from typing import Final, NamedTuple

MOST_BYTES: Final = 64 << 20


class Datagram(NamedTuple):
    """One datagram as it arrived."""

    exporter: str
    port: int
    """From which it was sent."""
    received_us: int
    """us since the epoch."""
    content: bytes


class DatagramQueue:
    """Takes what there is room for; what there is none for is counted.

    Args:
        most: datagrams that may wait.
        most_bytes: their bytes together.
    """

    def __init__(self, most: int, most_bytes: int = MOST_BYTES) -> None:
        self._most = most
        self._most_bytes = most_bytes
        self._lock = threading.Lock()
        self._waiting: deque[Datagram] = deque()
        self._bytes = 0
        self.dropped = 0
        """Datagrams for which there was no room."""

    def put(self, datagram: Datagram) -> None:
        """Add a datagram, or count it as dropped."""
        size = len(datagram.content)
        with self._lock:
            if len(self._waiting) >= self._most or self._bytes + size > self._most_bytes:
                self.dropped += 1
                return
            self._waiting.append(datagram)
            self._bytes += size

    def __len__(self) -> int:
        return len(self._waiting)

    def take(self, most: int) -> list[Datagram]:
        """The oldest datagrams, `most` at most."""
        with self._lock:
            found = [self._waiting.popleft() for _ in range(min(most, len(self._waiting)))]
            self._bytes -= sum(len(datagram.content) for datagram in found)
        return found
