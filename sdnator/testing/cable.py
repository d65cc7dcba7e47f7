"""A cable between controller and switch that a test can cut: a TCP relay that goes silent, both ends open."""

import socket
import threading
from contextlib import suppress
from typing import Self


class Cable:
    """`with Cable(address) as cable:` relays from `cable.address`; `cut()` holds back all bytes, `mend()` ends that.

    While it is cut, nobody accepts new connections; open ones stay open and silent, as with
    a pulled plug.  `mend` ends the silent ones, as a peer that gave up would have.

    Args:
        target: HOST:PORT at the far end.
    """

    def __init__(self, target: str) -> None:
        host, _, port = target.rpartition(":")
        self._target = (host, int(port))
        self._whole = threading.Event()
        self._whole.set()
        self._sockets: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"

    def __enter__(self) -> Self:
        threading.Thread(target=self._accept, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._whole.set()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._end_all()

    def cut(self) -> None:
        """Let no byte pass from now on."""
        self._whole.clear()

    def mend(self) -> None:
        """End the open connections, and let new ones through."""
        self._end_all()
        self._whole.set()

    def _end_all(self) -> None:
        sockets, self._sockets = self._sockets, []
        for each in sockets:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            self._sockets.append(near)
            threading.Thread(target=self._join, args=(near,), daemon=True).start()

    def _join(self, near: socket.socket) -> None:
        self._whole.wait()
        try:
            far = socket.create_connection(self._target, 5)
        except OSError:
            near.close()
            return
        far.settimeout(None)
        self._sockets.append(far)
        back = threading.Thread(target=self._relay, args=(far, near), daemon=True)
        back.start()
        self._relay(near, far)
        back.join()
        near.close()
        far.close()

    def _relay(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                self._whole.wait()
                sink.sendall(data)
        for each in (source, sink):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
