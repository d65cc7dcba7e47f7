"""Nobody keeps the pages from others by connecting: what never becomes a request is closed, what is in use stays."""

import asyncio
import socket
import threading

import httpx
import pytest
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Route, WebSocketRoute
from websockets.sync.client import connect

from coordinator import web_server
from sdnator.testing.waiting import wait_for


class Served:
    """A page, one that takes until it is let go, and an echo."""

    def __init__(self):
        self.asked, self.let_go = threading.Event(), threading.Event()
        listener = socket.create_server(("127.0.0.1", 0))
        self.address = listener.getsockname()
        self.url = f"http://127.0.0.1:{self.address[1]}"
        routes = [
            Route("/", lambda _: PlainTextResponse("the page")),
            Route("/slow", self._slow),
            Route("/large", self._large),
            WebSocketRoute("/echo", self._echo),
        ]
        self.server = web_server.web_server(Starlette(routes=routes))
        run = self.server.serve(sockets=[listener])
        self.thread = threading.Thread(target=lambda: asyncio.run(run))
        self.thread.start()
        wait_for(lambda: self.server.started)

    def _large(self, _):
        self.asked.set()
        return PlainTextResponse(b"x" * (16 << 20))

    def _slow(self, _):
        self.asked.set()
        self.let_go.wait(60)
        return PlainTextResponse("at last")

    async def _echo(self, websocket):
        await websocket.accept()
        while True:
            await websocket.send_text(await websocket.receive_text())

    def connected(self, sent=b""):
        """A client that has sent something and waits."""
        made = socket.create_connection(self.address, timeout=60)
        made.sendall(sent)
        return made


def closed(client):
    """Wait for what the server says until it closes; its answer."""
    said = b""
    try:
        while some := client.recv(4096):
            said += some
    except ConnectionResetError:
        pass
    client.close()
    return said


@pytest.fixture
def served():
    made = Served()
    yield made
    made.let_go.set()
    made.server.should_exit = made.server.force_exit = True
    made.thread.join(60)


GET = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
POST = b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\nname"


@pytest.mark.parametrize(
    ("sent", "said"),
    [(b"", b""), (GET, b""), (GET + b"\r\n", b"the page"), (GET + b"\r\n" + GET, b"the page")],
    ids=["nothing", "half", "whole", "one-and-a-half"],
)
def test_a_connection_without_a_request_is_closed(served, monkeypatch, sent, said):
    monkeypatch.setattr(web_server, "WAIT_SECONDS", 1.0)
    assert closed(served.connected(sent)).endswith(said)


def test_a_request_whose_body_does_not_come_is_closed(served, monkeypatch):
    monkeypatch.setattr(web_server, "WAIT_SECONDS", 0.2)
    assert b"405" in closed(served.connected(POST))


def test_a_client_that_reads_nothing_is_closed(served, monkeypatch):
    monkeypatch.setattr(web_server, "WAIT_SECONDS", 1.0)
    connections = served.server.server_state.connections
    with served.connected(GET.replace(b"/ ", b"/large ") + b"\r\n"):
        assert served.asked.wait(60)
        wait_for(lambda: not connections)


def test_pages_that_are_open_and_answers_that_take_long_stay(served, monkeypatch):
    monkeypatch.setattr(web_server, "WAIT_SECONDS", 2.0)
    slow_page = GET.replace(b"/ ", b"/slow ") + b"Connection: close\r\n\r\n"
    with connect(served.url.replace("http", "ws") + "/echo") as page, served.connected(slow_page) as slow:
        assert served.asked.wait(60)
        assert closed(served.connected()) == b"", "this one came later, and its time is over"
        page.send("still here")
        assert page.recv() == "still here"
        served.let_go.set()
        assert closed(slow).endswith(b"at last")


def test_of_too_many_connections_the_one_that_waits_longest_gives_way(served, monkeypatch):
    """A browser sends its request at once."""
    monkeypatch.setattr(web_server, "MOST_CONNECTIONS", 4)
    silent = []
    for number in range(4):
        silent.append(served.connected())
        wait_for(lambda: len(served.server.server_state.connections) == number + 1)  # noqa: B023 - at once
    with httpx.Client(base_url=served.url, timeout=60) as browser:
        assert browser.get("/").text == "the page"
        assert closed(silent[0]) == b""
        assert len(served.server.server_state.connections) == 4
    for client in silent[1:]:
        client.close()


def test_where_all_connections_are_in_use_another_one_is_refused(served, monkeypatch):
    monkeypatch.setattr(web_server, "MOST_CONNECTIONS", 1)
    with connect(served.url.replace("http", "ws") + "/echo") as page:
        assert closed(served.connected(GET + b"\r\n")) == b""
        page.send("still here")
        assert page.recv() == "still here"
