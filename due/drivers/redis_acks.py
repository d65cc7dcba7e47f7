"""Acknowledgements of one member on their way to its group's work lists.

callbacks return ──► waiting ──with the next request──► sent ──answered──► gone
                        ▲                                 └── connection lost ──► waiting
another life of the server: forgotten, since its ids mean others; what was done comes again, as a repeat
"""

from collections import deque

from due.drivers.base import Delivery
from due.drivers.redis_wire import pack
from due.drivers.redis_work import packed_done

_SKIP_REPLY = pack((b"CLIENT", b"REPLY", b"SKIP"))


class Acknowledgements:
    """Belongs to the thread that reads."""

    def __init__(self, group: str) -> None:
        self._group = group
        self._waiting: deque[tuple[str, str]] = deque()
        self._sent: deque[tuple[str, str]] = deque()
        self._lives = 0
        """How often the server was restarted or replaced."""

    def __len__(self) -> int:
        return len(self._waiting)

    def token(self, entry: str) -> str:
        """Names an entry in a delivery."""
        return f"{entry}@{self._lives}"

    def done(self, delivery: Delivery) -> None:
        """Its callbacks have returned."""
        entry, _, life = delivery.token.partition("@")
        if life == str(self._lives):
            self.add(delivery.path, entry)

    def add(self, path: str, entry: str) -> None:
        """Acknowledge an entry of the list as it is now."""
        self._waiting.append((path, entry))

    def packed(self, *, quietly: bool) -> tuple[bytes, int]:
        """Commands for all that wait, and how many replies they bring: none if `quietly`."""
        command, replies = b"", 0
        while self._waiting:
            path, entries = self._waiting[0][0], []
            while self._waiting and self._waiting[0][0] == path:
                self._sent.append(self._waiting[0])
                entries.append(self._waiting.popleft()[1])
            for one in packed_done(self._group, path, entries):
                command += _SKIP_REPLY + one if quietly else one
                replies += not quietly
        return command, replies

    def answered(self) -> None:
        """The server has all that were sent."""
        self._sent.clear()

    def lost(self) -> None:
        """The connection is another one: what was sent is sent again."""
        self._waiting.extendleft(reversed(self._sent))
        self._sent.clear()

    def forget(self) -> None:
        """The server is another one, or has lost its data."""
        self._lives += 1
        self._waiting.clear()
        self._sent.clear()
