"""Who may look at the page and who may act: token, link or user, and the browsers that came with one.  Pure but for
the files that hold users and link."""

import hashlib
import hmac
import ipaddress
import logging
import secrets
from collections import Counter, OrderedDict, deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
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
_NAMES = 4096
"""Names share so many places, whether anybody has them or not: none is forgotten for another's sake, and how long one
waits does not tell which exist."""
_MOST_WAITING, _MOST_OF_ORIGIN = 32, 4
"""Attempts that wait at once; the right token is not among them."""
_WRONG = "wrong name and password, or wrong token"

log = logging.getLogger(__name__)


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


def origin_of(source: str) -> str:
    """What counts as one address: whoever has one of IPv6 has all of its /64, and a local user all of 127.0.0.0/8."""
    try:
        address = ipaddress.ip_address(source)
    except ValueError:
        return source
    if isinstance(address, ipaddress.IPv6Address):
        address = address.ipv4_mapped or address
    if address.is_loopback:
        return "loopback"
    return str(address) if address.version == 4 else f"{int(address) >> 64:x}::/64"


class WaitingRoom:
    """Places for attempts that wait to be judged; one origin has a few, so that it cannot take those of others."""

    def __init__(self) -> None:
        self._taken: Counter[str] = Counter()

    @contextmanager
    def place(self, origin: str) -> Iterator[bool]:
        """Keep a place; yields whether there was one."""
        if self._taken.total() >= _MOST_WAITING or self._taken[origin] >= _MOST_OF_ORIGIN:
            yield False
            return
        self._taken[origin] += 1
        try:
            yield True
        finally:
            self._taken[origin] -= 1
            if not self._taken[origin]:
                del self._taken[origin]


class Throttle:
    """Makes guessing slow for the address it comes from and for the account it is about, and bars nobody: the owner
    may sit behind the same address.

    Args:
        most: sources that are remembered, the latest.
    """

    def __init__(self, most: int = _SOURCES) -> None:
        self._tries: OrderedDict[str, deque[float]] = OrderedDict()
        self._most = most

    def delay_s(self, source: str, now: float) -> float:
        """Seconds for which an attempt that begins now has to wait; `now` in seconds."""
        tries = self._tries.setdefault(source, deque(maxlen=_FREE_TRIES + 16))
        self._tries.move_to_end(source)
        while len(self._tries) > self._most:
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
        self._by_source, self._by_name = Throttle(), Throttle(_NAMES)
        self._naming = secrets.token_bytes(16)
        self._damaged = False
        """Users cannot be read just now."""

    def delay_s(self, source: str, name: str, now: float) -> float:
        """Seconds to wait before `sign_in` as this user from this address; `now` in seconds."""
        by_name = self._by_name.delay_s(self._place_of(name), now) if name else 0.0
        return max(by_name, self._by_source.delay_s(origin_of(source), now))

    def _place_of(self, name: str) -> str:
        digest = hashlib.blake2s(name.encode("utf-8", "replace"), key=self._naming).digest()
        return str(int.from_bytes(digest[:4], "big") % _NAMES)

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
        users = self._current_users()
        found = users.verified(name, password) if users is not None else None
        if found is None:
            return "", _WRONG
        self._by_name.forget(self._place_of(name))
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
        if found.user is not None:
            users = self._current_users()
            if users is None:
                return False  # until they can be read again: this one may have been removed
            if users.all.get(found.name) != found.user:  # removed, or with a new password or role
                self.sign_out(session)
                return False
        if now - found.used > IDLE_SECONDS:
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
        self._by_source.forget(origin_of(source))
        # never the browser's own number: an attacker who planted that would be signed in, too
        key = secrets.token_urlsafe(24)
        self._signed_in[key] = _Session(name, user, now)
        while len(self._signed_in) > _SESSIONS:
            self._signed_in.popitem(last=False)
        return key

    def _current_users(self) -> Users | None:
        """None: there are none, or their file is damaged, which lets nobody in; the owner has the token."""
        if self._users is None:
            return None
        try:
            self._users.reread()
        except BadInput as error:
            if not self._damaged:
                log.error("nobody signs in by name until this is repaired: %s", error)  # noqa: TRY400
            self._damaged = True
            return None
        if self._damaged:
            log.warning("users can be read again")
        self._damaged = False
        return self._users
