"""Foreign names and pages of other sites get no answer."""

import asyncio

import pytest

from sdnator.dashboard.server import Guard, named_well


@pytest.mark.parametrize(
    ("host", "well"),
    [
        ("localhost:8470", True),
        ("127.0.0.1:8470", True),
        ("[::1]:8470", True),
        ("192.0.2.1", True),
        ("board.example.org", True),
        ("evil.example.org:8470", False),
        ("", False),
        ("[::1", False),
        ("[:%1]:80", False),
    ],
)
def test_names_that_may_be_asked(host, well):
    assert named_well(host, {"board.example.org"}) is well


def asked(kind="http", **headers):
    """What a browser gets back."""
    sent = []

    async def app(_scope, _receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def send(message):
        sent.append(message)

    scope = {"type": kind, "headers": [(name.encode(), value.encode()) for name, value in headers.items()]}
    asyncio.run(Guard(app, ())(scope, None, send))
    return sent


def test_a_page_of_another_site_reaches_nothing():
    assert asked(host="127.0.0.1:1", origin="http://127.0.0.1:1")[0]["status"] == 200
    assert asked(host="127.0.0.1:1", origin="http://evil.example")[0]["status"] == 403
    assert asked(host="127.0.0.1:1", origin="http://[::1")[0]["status"] == 403
    assert asked(host="evil.example")[0]["status"] == 403
    assert asked("websocket", host="127.0.0.1:1", origin="http://evil.example")[0]["code"] == 1008


def test_answers_forbid_frames():
    assert (b"x-frame-options", b"DENY") in asked(host="localhost")[0]["headers"]
