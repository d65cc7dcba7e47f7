"""An HTTP server that accepts blocks as another firewall would, for tests of `webhook_enforcer`."""

import hmac
import json
import ssl
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self

from apps.enforcers.webhook_enforcer.exchange import signature

SECRET = b"a secret of the tests, only theirs"
_OLD_S = 300


class WebhookServer:
    """Keeps blocks by id, checks signatures, and gives the same answer to the same request.

    Args:
        tls: of the server; None: plain HTTP.
    """

    def __init__(self, tls: ssl.SSLContext | None = None) -> None:
        self.blocks: dict[str, dict[str, Any]] = {}
        """What stands, by decision id."""
        self.requests: list[tuple[str, str]] = []
        """Method and idempotency key of every request, refused ones too."""
        self.answer: Callable[[dict[str, Any]], tuple[int, Any]] | None = None
        """Answers a POST instead of the usual way: status and JSON."""
        self._answered: dict[str, tuple[int, Any]] = {}
        owner = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                owner.requests.append(("GET", ""))
                self._say(
                    *(owner.refusal(self, b"") or (200, {"blocks": [{"id": name} for name in owner.blocks]}))
                )

            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                owner.requests.append(("POST", self.headers["Idempotency-Key"]))
                self._say(*(owner.refusal(self, body) or owner.post(self.headers["Idempotency-Key"], body)))

            def _say(self, status: int, value: Any) -> None:
                body = json.dumps(value).encode()
                self.send_response(status)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: object) -> None:
                """Nothing on standard error."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        if tls is not None:
            self._server.socket = tls.wrap_socket(self._server.socket, server_side=True)
        self._scheme = "http" if tls is None else "https"

    @property
    def url(self) -> str:
        """Where it serves."""
        return f"{self._scheme}://127.0.0.1:{self._server.server_address[1]}/blocks?site=1"

    def __enter__(self) -> Self:
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def refusal(self, request: BaseHTTPRequestHandler, body: bytes) -> tuple[int, Any] | None:
        """The answer to a request whose signature or time is wrong; None: both are right."""
        at = int(request.headers.get("SDNator-Timestamp", 0))
        wanted = signature(SECRET, request.command, request.path, at, body)
        given = request.headers.get("SDNator-Signature", "")
        if hmac.compare_digest(wanted, given) and abs(time.time() - at) < _OLD_S:
            return None
        return 401, {"state": "failed", "cause": "the signature is wrong"}

    def post(self, key: str, body: bytes) -> tuple[int, Any]:
        """Take a block or its end."""
        said = json.loads(body)
        if self.answer is not None:
            return self.answer(said)
        if key not in self._answered:
            name = said["id"]
            if said["action"] == "block":
                state = "exists" if name in self.blocks else "installed"
                self.blocks[name] = said
            else:
                state = "removed"
                self.blocks.pop(name, None)
            self._answered[key] = 200, {"state": state}
        return self._answered[key]
