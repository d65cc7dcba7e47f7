"""Who may change something: the token, compared in constant time, and the browsers that gave it.  Pure."""

import hmac
from collections import OrderedDict, deque
from collections.abc import Mapping
from pathlib import Path

VARIABLE = "SDNATOR_DASHBOARD_TOKEN"
_SESSIONS = 64
_REMEMBERED_SECONDS = 60.0
_FREE_TRIES = 2
_DELAY_SECONDS, _LONGEST_DELAY_SECONDS = 0.5, 4.0
_SOURCES = 256
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


class Throttle:
    """Makes guessing slow for the address it comes from, and bars nobody: the owner may sit behind the same one."""

    def __init__(self) -> None:
        self._tries: OrderedDict[str, deque[float]] = OrderedDict()

    def delay_s(self, source: str, now: float) -> float:
        """Seconds for which this attempt has to wait; tries count from their beginning, so that many at once
        gain nothing.  `now` in seconds."""
        tries = self._tries.setdefault(source, deque(maxlen=_FREE_TRIES + 16))
        self._tries.move_to_end(source)
        while len(self._tries) > _SOURCES:
            self._tries.popitem(last=False)
        while tries and now - tries[0] >= _REMEMBERED_SECONDS:
            tries.popleft()
        tries.append(now)
        over = len(tries) - _FREE_TRIES
        return min(_LONGEST_DELAY_SECONDS, _DELAY_SECONDS * 2.0 ** (over - 1)) if over > 0 else 0.0

    def forget(self, source: str) -> None:
        """Somebody there had the token."""
        self._tries.pop(source, None)


class Sessions:
    """Browsers that have signed in; the oldest is signed out when there are too many."""

    def __init__(self, token: str) -> None:
        self._token = token.encode()
        self._signed_in: OrderedDict[str, None] = OrderedDict()
        self._throttle = Throttle()

    @property
    def possible(self) -> bool:
        """Whether there is a token at all."""
        return bool(self._token)

    def delay_s(self, source: str, now: float) -> float:
        """Seconds to wait before `sign_in` for a browser at this address; `now` in seconds."""
        return self._throttle.delay_s(source, now)

    def sign_in(self, session: str, token: str, source: str) -> str:
        """Empty where the browser is signed in, else why not; the right token always does."""
        if not self._token:
            return "there is no token: nobody can sign in"
        if not hmac.compare_digest(token.strip().encode("utf-8", "replace"), self._token):
            return "this is not the token"
        self._throttle.forget(source)
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
