"""The door of the pages: who has not signed in gets the sign-in form and nothing else.

browser ──► Guard (names, other sites) ──► cookie ──► AccessControl ─┬─ /sign-in, /sign-out, /link/…  answered here
                                                           ├─ signed in                     the pages
                                                           └─ else                          to /sign-in, or 401
"""

import asyncio
import html
import time
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qs
from weakref import WeakValueDictionary

from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response

from sdnator.dashboard.sign_in import Sessions, WaitingRoom, origin_of
from sdnator.rights.audited_deed import REFUSED
from sdnator.rights.sign_in_link import PATH as LINK
from sdnator.rights.users import OWNER

SIGN_IN, SIGN_OUT = "/sign-in", "/sign-out"
KEY = "signed_in"
"""Of the cookie: the key of the browser's session."""
_MOST_BYTES = 4096
_POLICY = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:; form-action 'self'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
}
_FORM = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>SDNator: sign in</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">
<style>
:root {{ color-scheme: light dark }}
body {{ font: 16px system-ui, sans-serif; display: grid; place-items: center; min-height: 90vh; margin: 0 }}
form {{ display: grid; gap: .75rem; width: min(22rem, 88vw) }}
input, button {{ font: inherit; padding: .5rem; width: 100%; box-sizing: border-box }}
.fault {{ min-height: 1.5em; font-weight: 600 }}
</style></head>
<body><form method="post" action="{action}" class="sign-in"><h1>SDNator</h1>
<label class="name">Name <input name="name" autocomplete="username" autofocus></label>
<label class="token">Password, or the token without a name
<input name="password" type="password" autocomplete="current-password"></label>
<button class="sign-in-now">Sign in</button>
<div class="fault" role="alert">{fault}</div>
<p>Who started the pipeline gets a link that signs in: <code>sdnator user link</code></p>
</form></body></html>
"""
_ON = (
    '<!doctype html><html lang="en"><head><title>SDNator</title><link rel="icon" href="data:,">'
    '<meta http-equiv="refresh" content="0; url=/"></head></html>\n'
)

Noted = Callable[[str, str, str], None]
"""Who, what they did at the door, and from where."""


class AccessControl:
    """ASGI, within the middleware that reads the cookie into `scope["session"]`.

    Args:
        app: the pages.
        sessions: who has signed in.
        noted: told of every sign-in, sign-out and refusal.
    """

    def __init__(self, app: Any, sessions: Sessions, noted: Noted) -> None:
        self._app = app
        self._sessions = sessions
        self._noted = noted
        self._hashing = asyncio.Lock()
        self._waiting = WaitingRoom()
        self._turns: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        """By name, while attempts at it wait."""

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """ASGI."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        signed_in = self._sessions.may_look(str(scope["session"].get(KEY, "")), time.monotonic())
        if scope["type"] == "websocket":
            if signed_in:
                await self._app(scope, receive, send)
            else:
                await send({"type": "websocket.close", "code": 1008})
            return
        answer = await self._own(Request(scope, receive))
        if answer is None and signed_in:
            await self._app(scope, receive, send)
            return
        await (answer or _refused(scope))(scope, receive, send)

    async def _own(self, request: Request) -> Response | None:
        """The answer to what is asked of the door itself; None: it is not."""
        path, method = request.url.path, request.method
        if path == SIGN_IN and method == "POST":
            return await self._sign_in(request)
        if path == SIGN_IN and method in ("GET", "HEAD"):
            return _form("")
        if path == SIGN_OUT and method == "POST":
            return self._sign_out(request)
        if path.startswith(LINK) and method == "GET":
            return self._by_link(request)
        return None

    async def _sign_in(self, request: Request) -> Response:
        if "origin" not in request.headers:  # another site's is refused by the Guard
            return PlainTextResponse("refused: sign in on the page\n", 403)
        given = await _fields(request)
        if given is None:
            return PlainTextResponse("refused: more than a name and a password\n", 413)
        name, password = given
        source = request.client.host if request.client is not None else ""
        judged = await self._judged(name, password, source)
        if judged is None:
            return _form("too many people are signing in just now: try again, or use the token", 503)
        key, wrong = judged
        if wrong:
            self._noted(name or OWNER, REFUSED, source)
            return _form(wrong, 401)
        return self._begin(request, key, "signed in", source)

    async def _judged(self, name: str, password: str, source: str) -> tuple[str, str] | None:
        """The session's key, or why there is none; None: there was no place to wait."""
        with self._waiting.place(origin_of(source)) as free:
            if not name:
                # the token, which is long, lets the owner in whoever else waits; whoever has a wrong one waits
                key, wrong = self._sessions.sign_in(name, password, source, time.monotonic())
                if wrong and free:
                    await asyncio.sleep(self._sessions.delay_s(source, name, time.monotonic()))
                return key, wrong
            if not free:
                return None
            # one after the other, whether or not there is such a user: otherwise many at once would wait side by side
            async with self._turns.setdefault(name, asyncio.Lock()):
                await asyncio.sleep(self._sessions.delay_s(source, name, time.monotonic()))
                async with self._hashing:  # one at a time: each takes 32 MiB
                    return await asyncio.to_thread(
                        self._sessions.sign_in, name, password, source, time.monotonic()
                    )

    def _by_link(self, request: Request) -> Response:
        source = request.client.host if request.client is not None else ""
        key = self._sessions.by_link(request.url.path.removeprefix(LINK), source, time.monotonic())
        if not key:
            return _form("this link has been used, or a newer one was created: run `sdnator user link`", 401)
        return self._begin(request, key, "signed in by a link", source)

    def _begin(self, request: Request, key: str, what: str, source: str) -> Response:
        request.session.clear()
        request.session[KEY] = key
        self._noted(self._sessions.name_of(key), what, source)
        # a redirect of a link from elsewhere would come without the cookie, which is for our own pages alone
        return HTMLResponse(_ON, headers={"Cache-Control": "no-store"})

    def _sign_out(self, request: Request) -> Response:
        if "origin" not in request.headers:
            return PlainTextResponse("refused: sign out on the page\n", 403)
        key = str(request.session.get(KEY, ""))
        if name := self._sessions.name_of(key):
            self._noted(name, "signed out", request.client.host if request.client is not None else "")
        self._sessions.sign_out(key)
        request.session.clear()
        return RedirectResponse(SIGN_IN, 303)


def _form(fault: str, status: int = 200) -> Response:
    return HTMLResponse(_FORM.format(action=SIGN_IN, fault=html.escape(fault)), status, headers=_POLICY)


def _refused(scope: Any) -> Response:
    if scope["path"] == "/" and scope["method"] in ("GET", "HEAD"):
        return RedirectResponse(SIGN_IN, 303)
    return PlainTextResponse("sign in first\n", 401)


async def _fields(request: Request) -> tuple[str, str] | None:
    """Name and password of the form; None where there is more than can be."""
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > _MOST_BYTES:
            return None
    try:
        found = parse_qs(body.decode("utf-8", "replace"), max_num_fields=8)
    except ValueError:
        return None
    return found.get("name", [""])[0].strip(), found.get("password", [""])[0]
