"""A publisher of data sets on this machine: the public servers' paths, ranges and versions."""

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote

UCI = "/ml/machine-learning-databases/00516"
"""Where the captures of Kitsune are."""


class Publisher:
    """A web server with files by path, ranges and versions; it can break off after some bytes."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.pages: dict[str, bytes] = {}
        self.break_after: list[int] = []
        self.asked: list[tuple[str, str | None]] = []
        publisher = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                publisher.answer(self)

            def log_message(self, *_args: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        path, wanted = unquote(request.path), request.headers.get("Range")
        self.asked.append((path, wanted))
        if path not in self.files and path not in self.pages:
            request.send_error(404)
            return
        whole = self.files.get(path, self.pages.get(path, b""))
        version = f'"{hashlib.sha256(whole).hexdigest()}"'
        start = 0
        if wanted and request.headers.get("If-Range") == version:
            start = int(wanted.removeprefix("bytes=").removesuffix("-"))
        request.send_response(206 if start else 200)
        if start:
            request.send_header("Content-Range", f"bytes {start}-{len(whole) - 1}/{len(whole)}")
        request.send_header("ETag", version)
        kind = "text/html" if path in self.pages else "application/octet-stream"
        request.send_header("Content-Type", kind)
        request.send_header("Content-Length", str(len(whole) - start))
        request.end_headers()
        request.wfile.write(
            whole[start : start + self.break_after.pop(0)] if self.break_after else whole[start:]
        )


@contextmanager
def serving() -> Iterator[Publisher]:
    """A publisher that answers until the block ends."""
    publisher = Publisher()
    thread = threading.Thread(target=publisher.server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield publisher
    finally:
        publisher.server.shutdown()
        publisher.server.server_close()
        thread.join()
