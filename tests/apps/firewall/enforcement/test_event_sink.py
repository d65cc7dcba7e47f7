"""Events reach file, Redis list and webhook, in order; what does not is counted, and nobody waits."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from apps.firewall.enforcement.event_sink import (
    LIST_LENGTH,
    EventSink,
    event_sinks,
    to_file,
    to_redis_list,
    to_webhook,
)
from apps.firewall.settings import Settings
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_wire import client

PATIENCE = 60.0


class Hook(ThreadingHTTPServer):
    """Takes POSTs; refuses the first `refusals`."""

    daemon_threads = True

    def __init__(self, refusals: int = 0) -> None:
        super().__init__(("127.0.0.1", 0), Take)
        self.refusals = refusals
        self.tried = 0
        self.bodies: list[str] = []
        self.headers: dict[str, str] = {}
        self.thread = threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.05})

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/hook"

    def __enter__(self) -> "Hook":
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.thread.join()
        self.server_close()


class Take(BaseHTTPRequestHandler):
    """One POST."""

    server: Hook

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"])).decode()
        self.server.tried += 1
        self.server.headers = dict(self.headers.items())
        if self.server.refusals:
            self.server.refusals -= 1
            self.send_response(503)
        else:
            self.server.bodies.append(body)
            self.send_response(204)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Quiet."""


def test_webhook_is_tried_again_until_it_takes_it():
    """In order, as JSON, with its token; each once."""
    with Hook(refusals=2) as hook:
        sink = EventSink("webhook", to_webhook(hook.url, "secret"))
        for number in range(3):
            sink.put(json.dumps({"number": number}))
        sink.close(PATIENCE)
        assert [json.loads(body)["number"] for body in hook.bodies] == [0, 1, 2]
        assert hook.tried == 5
        assert hook.headers["Content-Type"] == "application/json"
        assert hook.headers["Authorization"] == "Bearer secret"
        assert (sink.delivered, sink.lost) == (3, 0)


def test_what_is_refused_every_time_is_lost_and_the_next_goes_on():
    """Counted; the number of attempts is bounded."""
    with Hook(refusals=2) as hook:
        sink = EventSink("webhook", to_webhook(hook.url), attempts=2)
        sink.put("1")
        sink.put("2")
        sink.close(PATIENCE)
        assert hook.bodies == ["2"]
        assert (sink.delivered, sink.lost) == (1, 1)


def test_nobody_waits_for_a_taker_that_hangs():
    """The queue is bounded; what does not fit, and what is left at the end, is counted."""
    hangs, goes_on = threading.Event(), threading.Event()

    def deliver(_: str) -> None:
        hangs.set()
        goes_on.wait(PATIENCE)

    sink = EventSink("slow", deliver, size=2)
    sink.put("1")
    assert hangs.wait(PATIENCE)
    for number in range(5):
        sink.put(str(number))
    assert sink.lost == 3
    sink.close(0.1)
    goes_on.set()
    sink._thread.join(PATIENCE)
    assert (sink.delivered, sink.lost) == (1, 5)


def test_redis_list_is_bounded_and_in_order(tmp_path, monkeypatch):
    """The oldest go."""
    monkeypatch.setattr("apps.firewall.enforcement.event_sink.LIST_LENGTH", 3)
    with EmbeddedServer(tmp_path / "redis") as server:
        sink = EventSink("eve_redis", to_redis_list(server.url, "events"))
        for number in range(5):
            sink.put(str(number))
        sink.close(PATIENCE)
        reader = client(server.url)
        assert reader.lrange("events", 0, -1) == [b"2", b"3", b"4"]
        reader.close()
    assert LIST_LENGTH > 3


def test_file_may_be_rotated_and_come_late(tmp_path):
    """It is opened for each line; a missing folder is tried again."""
    path = tmp_path / "later" / "eve.json"
    sink = EventSink("eve_file", to_file(str(path)))
    sink.put("1")
    path.parent.mkdir()
    sink.put("2")
    sink.close(PATIENCE)
    assert path.read_text() == "1\n2\n"


def test_by_the_settings():
    """None of them is there unless it is named; wrong URLs are refused at the start."""
    assert event_sinks(Settings()) == ([], [])
    with pytest.raises(ValueError, match="http"):
        event_sinks(Settings(webhook="ftp://example.org"))
