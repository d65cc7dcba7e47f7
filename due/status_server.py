"""`/metrics` and `/healthz` of one app, over HTTP, for Prometheus and supervisors.

    main thread ──report(text, state)──► StatusServer ◄── GET /metrics   the last report
    engine's threads ◄──asked── liveness() ──┘      ◄── GET /healthz  200, or 503 if the last report is old
                                                                     or a thread does not answer

Answers come from the last report and from what the engine knows of its threads: a scraper never runs code
of the app.
"""

import hmac
import json
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from due.errors import InvalidOption
from due.liveness import STALLED_SECONDS
from due.metrics import CONTENT_TYPE

_LOOPBACK = ("127.0.0.1", "::1", "localhost")
_REQUEST_SECONDS = 5.0
_MOST_CONNECTIONS = 16
"""Each has a thread; whoever connects beyond that takes the place of the oldest."""
_LEAST_TOKEN, _MOST_TOKEN = 16, 1024


class StatusServer:
    """Listens at once, answers from `start` on.  Raises `InvalidOption` if it cannot listen there.

    Args:
        address: HOST:PORT.
        token: what requests for /metrics bring as `Authorization: Bearer …`; empty: nothing.
    """

    def __init__(self, address: str, token: str = "") -> None:
        host, port = parse_address(address)
        self._wanted = f"Bearer {token}".encode() if token else b""
        self._text = ""
        self._state: Mapping[str, Any] = {}
        self._reported = time.monotonic()
        self.liveness: Callable[[], Mapping[str, Any]] = dict
        """The engine's `Liveness.state`; its `status` is "stalled" if a thread hangs."""
        try:
            self._server = _Server((host, port), _Handler)
        except OSError as error:
            raise InvalidOption(f"--metrics {address}: cannot listen: {error.strerror or error}") from None
        self._server.status = self
        self._server.hosts = _LOOPBACK if host in _LOOPBACK else ()
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.5}, name="due-status", daemon=True
        )

    @property
    def address(self) -> str:
        """HOST:PORT, the port as bound."""
        host, port = self._server.server_address[:2]
        return f"[{host!s}]:{port}" if ":" in str(host) else f"{host!s}:{port}"

    def start(self) -> None:
        """Start answering."""
        self._thread.start()

    def report(self, text: str, state: Mapping[str, Any]) -> None:
        """Set the answer from now on."""
        self._text, self._state, self._reported = text, state, time.monotonic()

    def admits(self, given: str) -> bool:
        """Whether the header `Authorization` lets read the metrics."""
        return not self._wanted or hmac.compare_digest(given.encode("latin-1", "replace"), self._wanted)

    def metrics(self) -> tuple[int, str, str]:
        """Status, content type and body of `/metrics`."""
        return 200, CONTENT_TYPE, self._text

    def health(self) -> tuple[int, str, str]:
        """The same of `/healthz`."""
        silent = time.monotonic() - self._reported
        shown = {"status": "ok", **self._state, "silent_s": round(silent, 1), **self.liveness()}
        if silent > STALLED_SECONDS:
            shown["status"] = "stalled"
        healthy = shown["status"] in ("ok", "busy")
        return 200 if healthy else 503, "application/json", json.dumps(shown) + "\n"

    def close(self) -> None:
        """Stop listening."""
        if self._thread.is_alive():
            self._server.shutdown()
        self._server.server_close()


def metrics_token(file: str) -> str:
    """The token in a file; empty where no file is named.  Raises `InvalidOption` for one that keeps nobody out."""
    if not file:
        return ""
    try:
        token = Path(file).read_text(encoding="ascii").strip()
    except (OSError, ValueError) as error:
        raise InvalidOption(f"--metrics-token {file}: {error}") from None
    if not _LEAST_TOKEN <= len(token) <= _MOST_TOKEN or not token.isprintable():
        raise InvalidOption(f"--metrics-token {file}: a token has {_LEAST_TOKEN} to {_MOST_TOKEN} characters")
    return token


def parse_address(text: str) -> tuple[str, int]:
    """HOST:PORT or [IPV6]:PORT; raises `InvalidOption`."""
    host, colon, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not (colon and host and port.isdecimal() and int(port) < 65536):
        raise InvalidOption(f"--metrics {text}: give HOST:PORT; port 0 takes a free one")
    return host, int(port)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 128
    block_on_close = False
    status: StatusServer
    hosts: tuple[str, ...]
    """Accepted Host names; empty: any.  On loopback this keeps web pages from reading."""

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self._lock = threading.Lock()
        self._connections: dict[Any, None] = {}
        super().__init__(address, handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread of its own, and make room for it: any user of the machine may connect and say nothing."""
        with self._lock:
            if len(self._connections) >= _MOST_CONNECTIONS:
                oldest = next(iter(self._connections))
                del self._connections[oldest]
                with suppress(OSError):
                    oldest.shutdown(socket.SHUT_RDWR)  # its thread reads the end, and closes it
            self._connections[request] = None
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """The connection is over."""
        with self._lock:
            self._connections.pop(request, None)
        super().shutdown_request(request)

    def server_bind(self) -> None:
        """Bind without looking up our own name, as the base class would."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that disconnects is not worth a report."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = _REQUEST_SECONDS

    def do_GET(self) -> None:
        """Answer one request."""
        answers = {"/metrics": self.server.status.metrics, "/healthz": self.server.status.health}
        answer = answers.get(self.path.partition("?")[0])
        if not self._asked_properly():
            self._send(400, "text/plain", "asked under another host's name\n")
        elif answer is None:
            self._send(404, "text/plain", "here are /metrics and /healthz\n")
        elif answer == self.server.status.metrics and not self._admitted():
            self._send(401, "text/plain", "send the token of the metrics: Authorization: Bearer …\n")
        else:
            self._send(*answer())

    def log_message(self, *_arguments: Any) -> None:
        """No line for each request."""

    def _admitted(self) -> bool:
        return self.server.status.admits(self.headers.get("Authorization", ""))

    def _asked_properly(self) -> bool:
        asked = self.headers.get("Host", "")
        name = asked[: asked.find("]") + 1] if asked.startswith("[") else asked.partition(":")[0]
        return not self.server.hosts or name.strip("[]") in self.server.hosts

    def _send(self, status: int, kind: str, body: str) -> None:
        data = body.encode()
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)
