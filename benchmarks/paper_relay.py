"""A delaying forwarder between pairs of interfaces, for kernels without netem: what comes in on one leaves on the other.

`python -m benchmarks.paper_relay a0,b0 a1,b1 …` in the namespace of the interfaces; each line on standard input is the
new one-way delay in seconds.  Frames keep their order; beyond `MOST_BYTES` in flight they are dropped and counted, and
the count is printed at the end.
"""

import select
import socket
import sys
import time
from collections import deque
from typing import Final

MOST_BYTES: Final = 256 << 20
_ALL: Final = 3
_SOL_PACKET, _IGNORE_OUTGOING = 263, 23
_FRAME: Final = 65_600
_BUFFER: Final = 8 << 20
_AT_ONCE: Final = 64


class DelayingRelay:
    """All pairs in one loop.

    Args:
        pairs: names of interfaces.
    """

    def __init__(self, pairs: list[tuple[str, str]]) -> None:
        self.dropped = 0
        self._delay = 0.0
        self._held = 0
        self._waiting: deque[tuple[float, socket.socket, bytes]] = deque()
        self._other: dict[int, tuple[socket.socket, socket.socket]] = {}
        self._poll = select.epoll()
        self._poll.register(sys.stdin.fileno(), select.EPOLLIN)
        for pair in pairs:
            one, two = (_opened(name) for name in pair)
            for source, sink in ((one, two), (two, one)):
                self._other[source.fileno()] = (source, sink)
                self._poll.register(source.fileno(), select.EPOLLIN)

    def run(self) -> None:
        """Forward until standard input ends."""
        while True:
            left = max(0.0, self._waiting[0][0] - time.monotonic()) if self._waiting else 1.0
            for number, _ in self._poll.poll(left):
                if number == sys.stdin.fileno():
                    line = sys.stdin.readline()
                    if not line:
                        return
                    self._delay = float(line)
                else:
                    self._take(*self._other[number])
            self._send()

    def _take(self, source: socket.socket, sink: socket.socket) -> None:
        for _ in range(_AT_ONCE):
            try:
                frame = source.recv(_FRAME)
            except OSError:
                return
            if self._held > MOST_BYTES:
                self.dropped += 1
                continue
            self._held += len(frame)
            self._waiting.append((time.monotonic() + self._delay, sink, frame))

    def _send(self) -> None:
        now = time.monotonic()
        while self._waiting and self._waiting[0][0] <= now:
            _, sink, frame = self._waiting.popleft()
            self._held -= len(frame)
            try:
                sink.send(frame)
            except OSError:  # the queue behind is full, as a switch's may be
                self.dropped += 1


def _opened(name: str) -> socket.socket:
    # protocol 0 until it is bound, or frames of all interfaces would come in
    made = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    made.setsockopt(_SOL_PACKET, _IGNORE_OUTGOING, 1)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
    made.bind((name, _ALL))
    made.setblocking(False)
    return made


if __name__ == "__main__":
    relay = DelayingRelay([(one, two) for one, _, two in (text.partition(",") for text in sys.argv[1:])])
    print("ready", flush=True)
    relay.run()
    print(relay.dropped, flush=True)
