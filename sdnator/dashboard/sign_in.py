"""Who may change something: the token, compared in constant time, and the browsers that gave it.  Pure."""

import hmac
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path

VARIABLE = "SDNATOR_DASHBOARD_TOKEN"
_SESSIONS = 64
_TRIES, _TRIES_SECONDS = 5, 60.0
LEAST = 16


class WeakToken(ValueError):
    """A token that is too short to keep anybody out."""


def token_from(file: str, environment: Mapping[str, str]) -> str:
    """The token: of the environment, else of the file; empty where there is none: then nobody can sign in.

    Raises WeakToken, OSError.
    """
    token = environment.get(VARIABLE, "").strip()
    place = f"${VARIABLE}"
    if not token and file:
        token, place = Path(file).read_text(encoding="utf-8").strip(), file
    if token and len(token) < LEAST:
        raise WeakToken(f"{place}: a token has at least {LEAST} characters")
    return token


class Sessions:
    """Browsers that have signed in; the oldest is signed out when there are too many."""

    def __init__(self, token: str) -> None:
        self._token = token.encode()
        self._signed_in: OrderedDict[str, None] = OrderedDict()
        self._failed: list[float] = []

    @property
    def possible(self) -> bool:
        """Whether there is a token at all."""
        return bool(self._token)

    def sign_in(self, session: str, token: str, now: float) -> str:
        """Empty where the browser is signed in, else why not; `now` in seconds."""
        if not self._token:
            return "there is no token: nobody can sign in"
        self._failed = [each for each in self._failed if now - each < _TRIES_SECONDS]
        if len(self._failed) >= _TRIES:
            return "too many wrong tokens: wait a minute"
        if not hmac.compare_digest(token.strip().encode(), self._token):
            self._failed.append(now)
            return "this is not the token"
        self._signed_in[session] = None
        while len(self._signed_in) > _SESSIONS:
            self._signed_in.popitem(last=False)
        return ""

    def sign_out(self, session: str) -> None:
        """From now on it may only look."""
        self._signed_in.pop(session, None)

    def may_act(self, session: str) -> bool:
        """Whether this browser has signed in."""
        return session in self._signed_in
