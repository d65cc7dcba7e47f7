"""Connections to Data Updates that can be cut and slowed down: a relay on Unix sockets for each part."""

import socket
import threading
import time
from contextlib import suppress
from pathlib import Path

_CHUNK = 65_536
_RETRY_S = 0.02
SLOW_BYTES_S = 64_000


class UnixLink:
    """Relays from a socket of its own to the server's; `cut` ends connections and takes no new ones.

    Args:
        path: of its socket, to be made.
        target: the server's socket.
    """

    def __init__(self, path: Path, target: Path) -> None:
        self.url = f"unix://{path}"
        self._target = str(target)
        self._whole = threading.Event()
        self._whole.set()
        self._slow = False
        self._flowing = threading.Event()
        self._flowing.set()
        self._ended = False
        self._lock = threading.Lock()
        self._sockets: set[socket.socket] = set()
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen(64)
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """As when a cable is pulled and both ends have noticed."""
        self._whole.clear()
        self._end_all()

    def slow(self) -> None:
        """At most `SLOW_BYTES_S` bytes a second each way and connection."""
        self._slow = True

    def hold(self) -> None:
        """As when a cable is pulled and nobody has noticed: what is sent arrives when it is whole again."""
        self._flowing.clear()

    def mend(self) -> None:
        """As before."""
        self._slow = False
        self._flowing.set()
        self._whole.set()

    def close(self) -> None:
        """No more connections."""
        self._ended = True
        self._whole.set()
        self._flowing.set()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._end_all()

    def _end_all(self) -> None:
        with self._lock:
            sockets, self._sockets = self._sockets, set()
        for each in sockets:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        while not self._ended:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._join, args=(near,), daemon=True).start()

    def _join(self, near: socket.socket) -> None:
        far = socket.socket(socket.AF_UNIX)
        try:
            self._whole.wait()
            far.connect(self._target)
        except OSError:
            near.close()
            far.close()
            time.sleep(_RETRY_S)
            return
        with self._lock:
            self._sockets |= {near, far}
        back = threading.Thread(target=self._relay, args=(far, near), daemon=True)
        back.start()
        self._relay(near, far)
        back.join()
        with self._lock:
            self._sockets -= {near, far}
        near.close()
        far.close()

    def _relay(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(_CHUNK):
                if self._slow:
                    time.sleep(len(data) / SLOW_BYTES_S)
                self._flowing.wait()
                sink.sendall(data)
        for each in (source, sink):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
