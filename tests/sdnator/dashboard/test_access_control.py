"""The door of the pages over real HTTP: nothing but the form for who has not signed in, and every deed is noted."""

import asyncio
import socket
import threading

import httpx
import pytest
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.sessions import SessionMiddleware
from starlette.responses import PlainTextResponse
from starlette.routing import Route, WebSocketRoute
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from coordinator.web_server import web_server
from sdnator.dashboard.access_control import AccessControl
from sdnator.dashboard.server import Guard
from sdnator.dashboard.sign_in import Sessions
from sdnator.rights.sign_in_link import FILE, new_link
from sdnator.rights.users import Users
from sdnator.testing.waiting import wait_for

TOKEN = "a long enough token"  # noqa: S105
PASSWORD = "correct horse battery"  # noqa: S105


class Door:
    """A server behind the gate, as the dashboard builds it, and what was noted."""

    def __init__(self, state):
        self.state = state
        self.noted = []
        users = Users(state)
        users.add("vera", "viewer", PASSWORD)
        self.sessions = Sessions(TOKEN, users, state / FILE)
        listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        app = Starlette(
            routes=[
                Route("/", lambda _: PlainTextResponse("the page")),
                Route("/files", lambda _: PlainTextResponse("a file")),
                WebSocketRoute("/ws", self._heard),
            ],
            middleware=[
                Middleware(
                    SessionMiddleware, secret_key="x" * 32, session_cookie="sdnator", same_site="strict"
                ),
                Middleware(
                    AccessControl, sessions=self.sessions, noted=lambda *words: self.noted.append(words)
                ),
            ],
        )
        self.server = web_server(Guard(app, ()))
        run = self.server.serve(sockets=[listener])
        self.thread = threading.Thread(target=lambda: asyncio.run(run))
        self.thread.start()
        wait_for(lambda: self.server.started, 60)

    async def _heard(self, websocket):
        await websocket.accept()
        await websocket.send_text("frames")
        await websocket.close()

    def browser(self):
        return httpx.Client(base_url=self.url, timeout=60)

    def stop(self):
        self.server.should_exit = True
        self.thread.join(60)


@pytest.fixture(scope="module")
def door(tmp_path_factory):
    made = Door(tmp_path_factory.mktemp("door"))
    yield made
    made.stop()


@pytest.fixture
def browser(door):
    door.noted.clear()
    with door.browser() as made:
        yield made


def sign_in(door, browser, name, password, **headers):
    form = {"name": name, "password": password}
    return browser.post("/sign-in", data=form, headers={"origin": door.url} | headers)


def looks(browser):
    return browser.get("/").text == "the page"


def test_who_has_not_signed_in_gets_the_form_and_nothing_else(door, browser):
    first = browser.get("/")
    assert (first.status_code, first.headers["location"]) == (303, "/sign-in")
    form = browser.get("/sign-in")
    assert form.status_code == 200
    assert "form-action 'self'" in form.headers["content-security-policy"]
    assert "default-src 'none'" in form.headers["content-security-policy"]
    for method, path in (
        ("GET", "/files"),
        ("POST", "/"),
        ("PUT", "/sign-in"),
        ("GET", "/sign-out"),
    ):
        assert browser.request(method, path).status_code == 401, (method, path)
    with pytest.raises(InvalidStatus) as caught:
        connect(door.url.replace("http", "ws") + "/ws")
    assert caught.value.response.status_code == 403
    assert door.noted == []


@pytest.mark.parametrize(("name", "password"), [("", TOKEN), ("vera", PASSWORD)])
def test_who_has_signed_in_gets_all_until_the_way_out(door, browser, name, password):
    answer = sign_in(door, browser, name, password)
    assert answer.status_code == 200
    cookie = answer.headers["set-cookie"]
    assert all(word in cookie.lower() for word in ("httponly", "samesite=strict"))
    assert password not in cookie
    assert looks(browser)
    words = {"Cookie": f"sdnator={browser.cookies['sdnator']}"}
    with connect(door.url.replace("http", "ws") + "/ws", additional_headers=words) as heard:
        assert heard.recv() == "frames"
    who = name or "owner"
    old = browser.cookies["sdnator"]
    assert browser.post("/sign-out").status_code == 403, "another site's page would have no origin of ours"
    assert browser.post("/sign-out", headers={"origin": door.url}).status_code == 303
    assert not looks(browser)
    browser.cookies.set("sdnator", old)
    assert not looks(browser), "a copied cookie ends, too"
    assert [(one, deed) for one, deed, _ in door.noted] == [(who, "signed in"), (who, "signed out")]


def test_a_link_works_once(door, browser):
    secret = new_link(door.state, door.url).removeprefix(door.url)
    assert browser.head(secret).status_code == 401, "only who opens it uses it up"
    answer = browser.get(secret)
    assert (answer.status_code, "refresh" in answer.text) == (200, True)
    assert looks(browser)
    with door.browser() as other:
        assert other.get(secret).status_code == 401
        assert not looks(other)
    assert [deed for _, deed, _ in door.noted] == ["signed in by a link"]


def test_a_wrong_password_is_noted_and_the_right_one_still_works(door, browser):
    for _ in range(2):
        answer = sign_in(door, browser, "vera", "not the password")
        assert (answer.status_code, "wrong name and password" in answer.text) == (401, True)
    assert not looks(browser)
    assert sign_in(door, browser, "vera", PASSWORD).status_code == 200
    assert [(who, deed) for who, deed, _ in door.noted] == [
        *[("vera", "refused to sign in")] * 2, ("vera", "signed in"),
    ]  # fmt: skip


def test_no_page_of_another_site_signs_anybody_in(door, browser):
    form = {"name": "", "password": TOKEN}
    assert browser.post("/sign-in", data=form).status_code == 403
    assert sign_in(door, browser, "", TOKEN, origin="http://evil.example").status_code == 403
    assert not looks(browser)


def test_a_cookie_that_was_there_before_is_not_signed_in(door, browser):
    """Whoever plants one in another's browser shares nothing with it afterwards."""
    browser.cookies.set("sdnator", "planted")
    sign_in(door, browser, "", TOKEN)
    assert browser.cookies.get("sdnator", domain="127.0.0.1") != "planted"


@pytest.mark.parametrize(
    "body", ["name=" + "x" * 5000, "&".join("a=1" for _ in range(100)), "%ff%00", "name=a%0ab&password=x"]
)
def test_forms_that_are_none(door, browser, body):
    kind = {"origin": door.url, "content-type": "application/x-www-form-urlencoded"}
    assert browser.post("/sign-in", content=body, headers=kind).status_code in (401, 413)
    assert not looks(browser)


class Slow(Sessions):
    """Others than vera have to wait for hours; remembers the order of what was asked."""

    asked: list[str]

    def delay_s(self, _source, name, _now):
        self.asked.append("delay")
        return 0.0 if name == "vera" else 9_999.0

    def sign_in(self, name, password, source, now):
        self.asked.append("judge")
        return super().sign_in(name, password, source, now)


@pytest.fixture
def slow(door):
    made = Slow(TOKEN, Users(door.state))
    made.asked = []
    return made


async def status_of(access, name, password, source):
    """Of the answer to a form from an address."""
    sent = []

    async def receive():
        return {"type": "http.request", "body": f"name={name}&password={password}".encode()}

    async def send(message):
        sent.append(message)

    headers = [(b"host", b"localhost"), (b"origin", b"http://localhost")]
    scope = {"type": "http", "method": "POST", "path": "/sign-in", "query_string": b"", "headers": headers}
    await access(scope | {"client": (source, 1), "session": {}}, receive, send)
    return sent[0]["status"]


def test_attempts_at_one_name_wait_one_after_the_other(slow):
    """Side by side, as many as one likes would be judged after the delay of one."""
    access = AccessControl(None, slow, lambda *_: None)

    async def guess():
        return await asyncio.gather(*(status_of(access, "vera", f"guess{n}", "192.0.2.1") for n in range(9)))

    statuses = asyncio.run(guess())
    assert slow.asked == ["delay", "judge"] * 4
    assert sorted(statuses) == [401] * 4 + [503] * 5


def test_who_guesses_at_many_names_takes_the_places_of_one_address(slow):
    """Whichever addresses of its own a machine uses; from another one, and with the token, one signs in."""
    access = AccessControl(None, slow, lambda *_: None)

    async def flood():
        guesses = [asyncio.create_task(status_of(access, f"n{n}", "x", f"127.0.{n}.1")) for n in range(40)]
        assert set(await asyncio.gather(*guesses[4:])) == {503}
        found = [
            await status_of(access, *given)
            for given in (
                ("vera", PASSWORD, "127.0.0.1"),
                ("vera", PASSWORD, "192.0.2.1"),
                ("", TOKEN, "127.0.0.1"),
            )
        ]
        for guess in guesses:
            guess.cancel()
        return found

    assert asyncio.run(flood()) == [503, 200, 200]


def test_nobody_gives_an_address_that_is_not_theirs(door, browser):
    """Every local user could; the audit trail and what slows guessing go by it."""
    sign_in(door, browser, "", "not the token, but long", **{"x-forwarded-for": "192.0.2.1"})
    assert door.noted == [("owner", "refused to sign in", "127.0.0.1")]
