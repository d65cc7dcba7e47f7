"""Who may look at the page and who may act: token, link or user, and the browsers that came with one.  Pure but for
the files that hold users and link."""

import hmac
import secrets
from collections import OrderedDict, deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sdnator.errors import BadInput
from sdnator.rights.sign_in_link import used_up
from sdnator.rights.users import OWNER, PageUser, Users

VARIABLE = "SDNATOR_DASHBOARD_TOKEN"
LEAST = 16
IDLE_SECONDS = 12 * 3600.0
"""After this long without a request a browser has to sign in again."""
_SESSIONS = 64
_REMEMBERED_SECONDS = 60.0
_FREE_TRIES = 2
_DELAY_SECONDS, _LONGEST_DELAY_SECONDS = 0.5, 4.0
_SOURCES = 256
_WRONG = "wrong name and password, or wrong token"


class WeakToken(ValueError):
    """A token that is too short to keep anybody out."""


def token_from(file: str, environment: Mapping[str, str]) -> str:
    """The token: of the environment, else of the file; empty where there is none.

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
    """Makes guessing slow for the address it comes from and for the account it is about, and bars nobody: the owner
    may sit behind the same address."""

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
        """Somebody there had the password."""
        self._tries.pop(source, None)


@dataclass
class _Session:
    name: str
    user: PageUser | None
    """None: the owner."""
    used: float


class Sessions:
    """Browsers that have signed in; the one that was idle for longest is signed out when there are too many.

    Args:
        token: the owner's; empty: nobody signs in with one.
        users: further people; None: there are none.
        link: file of the link that signs in once.
    """

    def __init__(self, token: str, users: Users | None = None, link: Path | None = None) -> None:
        self._token = token.encode()
        self._users = users
        self._link = link
        self._signed_in: OrderedDict[str, _Session] = OrderedDict()
        self._throttle = Throttle()

    def delay_s(self, source: str, name: str, now: float) -> float:
        """Seconds to wait before `sign_in` as this user from this address; `now` in seconds."""
        by_name = self._throttle.delay_s(f"user {name}", now) if name else 0.0
        return max(by_name, self._throttle.delay_s(source, now))

    def sign_in(self, name: str, password: str, source: str, now: float) -> tuple[str, str]:
        """A new session for a browser.

        Args:
            name: of the user; empty: the password is the owner's token.
            password: what was given.
            source: address of the browser.
            now: in seconds, of a clock that does not jump.

        Returns:
            The session's key and "", or "" and why not; the right password always signs in.
        """
        if not name:
            given = password.strip().encode("utf-8", "replace")
            if not self._token or not hmac.compare_digest(given, self._token):
                return "", _WRONG
            return self._begun(OWNER, None, source, now), ""
        self._take_up()
        found = self._users.verified(name, password) if self._users is not None else None
        if found is None:
            return "", _WRONG
        self._throttle.forget(f"user {name}")
        return self._begun(name, found, source, now), ""

    def by_link(self, secret: str, source: str, now: float) -> str:
        """The key of a session for who has the link; empty where it is not the link, or was used."""
        if self._link is None or not used_up(self._link, secret):
            return ""
        return self._begun(OWNER, None, source, now)

    def sign_out(self, session: str) -> None:
        """From now on it gets nothing."""
        self._signed_in.pop(session, None)

    def may_look(self, session: str, now: float) -> bool:
        """Whether this browser has signed in, and its user is still what it was then; `now` in seconds."""
        found = self._signed_in.get(session)
        if found is None:
            return False
        if now - found.used > IDLE_SECONDS or not self._still(found):
            self.sign_out(session)
            return False
        found.used = now
        self._signed_in.move_to_end(session)
        return True

    def may_act(self, session: str, now: float) -> bool:
        """Whether this browser may look, and its user is an operator."""
        return self.may_look(session, now) and self.role_of(session) == "operator"

    def name_of(self, session: str) -> str:
        """Who sits there; empty: nobody."""
        found = self._signed_in.get(session)
        return "" if found is None else found.name

    def role_of(self, session: str) -> str:
        """The role of who sits there; empty: nobody's."""
        found = self._signed_in.get(session)
        return "" if found is None else "operator" if found.user is None else found.user.role

    def _begun(self, name: str, user: PageUser | None, source: str, now: float) -> str:
        self._throttle.forget(source)
        # never the browser's own number: an attacker who planted that would be signed in, too
        key = secrets.token_urlsafe(24)
        self._signed_in[key] = _Session(name, user, now)
        while len(self._signed_in) > _SESSIONS:
            self._signed_in.popitem(last=False)
        return key

    def _still(self, session: _Session) -> bool:
        """Removal, a new password and a new role end a session."""
        if session.user is None:
            return True
        self._take_up()
        return self._users is not None and self._users.all.get(session.name) == session.user

    def _take_up(self) -> None:
        if self._users is None:
            return
        try:
            self._users.reread()
        except BadInput:
            self._users = None  # a damaged file lets nobody in; the owner has the token
