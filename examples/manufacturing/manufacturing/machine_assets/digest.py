"""HTTP digest authentication (RFC 7616, MD5 and qop=auth, as the real printers use it) of one printer.

An app asks for credentials (`/auth/request`), is allowed at the printer's display (the emulator allows at once)
and then answers challenges.  Nonces are stateless: a time under a keyed hash.
"""

import hashlib
import hmac
import secrets
import time
from typing import Final
from urllib.request import parse_http_list, parse_keqv_list

REALM: Final = "Jedi-API"
MOST_USERS: Final = 64
_NONCE_S: Final = 300.0


class TooManyUsers(Exception):
    """No more credentials are given out."""


class DigestGate:
    """Credentials of one printer, and who knows them."""

    def __init__(self) -> None:
        self._secret = secrets.token_bytes(32)
        self._users: dict[str, str] = {}

    def register(self) -> tuple[str, str]:
        """New credentials, id and key; raises TooManyUsers."""
        if len(self._users) >= MOST_USERS:
            raise TooManyUsers(f"{MOST_USERS} apps have credentials already")
        name, key = secrets.token_hex(16), secrets.token_hex(32)
        self._users[name] = key
        return name, key

    def knows(self, name: str) -> bool:
        """Whether these credentials were given out and allowed."""
        return name in self._users

    def challenge(self) -> str:
        """For the header WWW-Authenticate."""
        return f'Digest realm="{REALM}", nonce="{self._nonce(int(time.time()))}", algorithm=MD5, qop="auth"'

    def allows(self, method: str, target: str, header: str) -> bool:
        """Whether a request's header Authorization answers a challenge of ours."""
        scheme, _, rest = header.partition(" ")
        if scheme.lower() != "digest":
            return False
        try:
            fields = parse_keqv_list(parse_http_list(rest))
            wanted = self._response(method, target, fields)
        except (ValueError, KeyError, IndexError):
            return False
        return self._is_ours(fields["nonce"]) and hmac.compare_digest(
            wanted.encode(), fields["response"].encode()
        )

    def _response(self, method: str, target: str, fields: dict[str, str]) -> str:
        if fields["uri"] != target or fields["qop"] != "auth":
            raise ValueError("of another request")
        key = self._users[fields["username"]]
        first = _md5(f"{fields['username']}:{REALM}:{key}")
        middle = f"{fields['nonce']}:{fields['nc']}:{fields['cnonce']}:{fields['qop']}"
        return _md5(f"{first}:{middle}:{_md5(f'{method}:{target}')}")

    def _nonce(self, moment: int) -> str:
        mark = hmac.new(self._secret, str(moment).encode(), hashlib.sha256).hexdigest()[:32]
        return f"{moment}-{mark}"

    def _is_ours(self, nonce: str) -> bool:
        moment, _, _ = nonce.partition("-")
        if not moment.isdecimal() or len(moment) > 12 or not nonce.isascii():
            return False
        return hmac.compare_digest(nonce, self._nonce(int(moment))) and time.time() - int(moment) < _NONCE_S


def _md5(text: str) -> str:
    return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()
