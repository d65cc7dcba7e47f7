"""I/O: a thread that receives datagrams on UDP ports and hands those of accepted exporters on.

The sender's address is all that says who sent a datagram, and it can be forged.
"""

import logging
import selectors
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Final

from flow_records.datagram_queue import Datagram, DatagramQueue

_LOOK_S: Final = 0.2
_AT_ONCE: Final = 256
"""Datagrams of one socket before the next is looked at."""
_LARGEST: Final = 65_535
_BUFFER_BYTES: Final = 4 << 20
"""Asked of the kernel for each socket; it may give less."""

log = logging.getLogger("flow_records")


class UdpListener:
    """Listens from its making until `close`.

    Args:
        listen: address to listen on; `::` is both IPv4 and IPv6.
        ports: UDP ports, 0 for a free one.
        exporter_of: name of the exporter at an address, None for one that is not accepted; called in the thread.
        queue: where datagrams go.

    Raises:
        OSError: an address or port cannot be listened on.
    """

    def __init__(
        self,
        listen: str,
        ports: Sequence[int],
        exporter_of: Callable[[str], str | None],
        queue: DatagramQueue,
    ) -> None:
        self._exporter_of = exporter_of
        self._queue = queue
        self._stopping = threading.Event()
        self._stack = ExitStack()
        self._selector = self._stack.enter_context(selectors.DefaultSelector())
        self.addresses: list[str] = []
        """HOST:PORT of each socket."""
        self.failure = ""
        """What ended the thread; empty while it works."""
        with self._stack:
            for port in ports:
                self._open(listen, port)
            self._stack = self._stack.pop_all()
        self._thread = threading.Thread(target=self._run, name="flow-listener", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop, and close the sockets."""
        self._stopping.set()
        self._thread.join()
        self._stack.close()

    def _open(self, listen: str, port: int) -> None:
        family = socket.AF_INET6 if ":" in listen else socket.AF_INET
        one = self._stack.enter_context(socket.socket(family, socket.SOCK_DGRAM))
        if family == socket.AF_INET6:
            one.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        one.setblocking(False)
        try:
            one.bind((listen, port))
        except OSError as error:
            raise OSError(error.errno, f"listen on {listen} port {port}: {error.strerror}") from None
        self._selector.register(one, selectors.EVENT_READ)
        host, bound = one.getsockname()[:2]
        self.addresses.append(f"[{host}]:{bound}" if ":" in host else f"{host}:{bound}")

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                for key, _ in self._selector.select(_LOOK_S):
                    assert isinstance(key.fileobj, socket.socket)  # noqa: S101 - only sockets are registered
                    self._receive(key.fileobj)
        except Exception as error:
            log.critical("the thread that receives flow records died", exc_info=True)
            self.failure = repr(error)

    def _receive(self, one: socket.socket) -> None:
        for _ in range(_AT_ONCE):
            try:
                content, sender = one.recvfrom(_LARGEST)
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                log.warning("receive: %s", error)
                return
            # an IPv4 sender at a socket for both is ::ffff:192.0.2.1; link-local addresses name their interface
            address = sender[0].removeprefix("::ffff:").partition("%")[0]
            exporter = self._exporter_of(address)
            if exporter is not None:
                self._queue.put(Datagram(exporter, sender[1], time.time_ns() // 1000, content))
