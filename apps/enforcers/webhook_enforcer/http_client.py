"""One HTTP server, asked with signed requests over one connection.  I/O.

No redirect is followed and no proxy used: a decision goes to the server that the settings name, or nowhere.
"""

import http.client
import ssl
import stat
import time
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from apps.enforcers.enforcer import EnforcerAway
from apps.enforcers.webhook_enforcer.exchange import idempotency_key, signature
from due.errors import InvalidOption

_SHORTEST_SECRET: Final = 16
_MOST_BYTES: Final = 8 << 20
"""Of an answer."""
_PIECE: Final = 1 << 16


def read_secret(path: str) -> bytes:
    """The secret without white space around it.

    Raises:
        InvalidOption: the file cannot be read, is readable by others, or holds too little.
    """
    file = Path(path)
    try:
        if file.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise InvalidOption(f"secret_file {path}: others can read it; run `chmod 600 {path}`")
        secret = file.read_bytes()[:4096].strip()
    except OSError as error:
        raise InvalidOption(
            f"secret_file {path}: cannot be read ({error.strerror}); name a file that this user can read"
        ) from None
    if len(secret) < _SHORTEST_SECRET:
        raise InvalidOption(
            f"secret_file {path}: {len(secret)} bytes; give {_SHORTEST_SECRET} or more random ones"
        )
    return secret


class SignedHttpClient:
    """Sends requests; raises `EnforcerAway` where no answer comes.

    Args:
        url: checked by the settings.
        secret: that signs.
        ca_file: CA certificates, PEM; empty: the system's.
        timeout_s: for one request and its answer.

    Raises `InvalidOption` for CA certificates that cannot be read.
    """

    def __init__(self, url: str, secret: bytes, ca_file: str, timeout_s: float) -> None:
        parts = urlsplit(url)
        self._host, self._port = parts.hostname or "", parts.port
        self._path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        self._secret = secret
        self._timeout_s = timeout_s
        self._tls = _context(ca_file) if parts.scheme == "https" else None
        self._connection: http.client.HTTPConnection | None = None

    def ask(self, method: str, body: bytes = b"") -> tuple[int, bytes]:
        """Send one request.

        Args:
            method: GET or POST.
            body: JSON.

        Returns:
            Status code and body of the answer.

        Raises:
            EnforcerAway: no connection, no answer in time, or too large a one.
        """
        reused = self._connection is not None
        try:
            return self._ask(method, body)
        except (OSError, http.client.HTTPException) as error:
            self.close()
            if not reused or isinstance(error, TimeoutError):
                raise EnforcerAway(f"{self._host}: {error or type(error).__name__}") from None
        try:  # a server may close a connection that was idle; requests may come twice
            return self._ask(method, body)
        except (OSError, http.client.HTTPException) as error:
            self.close()
            raise EnforcerAway(f"{self._host}: {error or type(error).__name__}") from None

    def close(self) -> None:
        """Close the connection; the next request opens another."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _ask(self, method: str, body: bytes) -> tuple[int, bytes]:
        deadline = time.monotonic() + self._timeout_s
        connection = self._connection = self._connection or self._opened()
        connection.request(method, self._path, body or None, self._headers(method, body))
        answer = connection.getresponse()
        found = bytearray()
        while piece := answer.read1(_PIECE):
            found += piece
            if len(found) > _MOST_BYTES:
                raise http.client.HTTPException(f"the answer has more than {_MOST_BYTES:,} bytes")
            if time.monotonic() > deadline:
                raise TimeoutError(f"no complete answer within {self._timeout_s:g} s")
        answer.close()  # read to its end: the connection may be used again
        if answer.will_close:
            self.close()
        return answer.status, bytes(found)

    def _opened(self) -> http.client.HTTPConnection:
        if self._tls is None:
            return http.client.HTTPConnection(self._host, self._port, timeout=self._timeout_s)
        return http.client.HTTPSConnection(self._host, self._port, timeout=self._timeout_s, context=self._tls)

    def _headers(self, method: str, body: bytes) -> dict[str, str]:
        now = int(time.time())
        named = {
            "User-Agent": "sdnator",
            "Accept": "application/json",
            "SDNator-Timestamp": str(now),
            "SDNator-Signature": signature(self._secret, method, self._path, now, body),
        }
        if body:
            named |= {"Content-Type": "application/json", "Idempotency-Key": idempotency_key(body)}
        return named


def _context(ca_file: str) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=ca_file or None)
    except (OSError, ssl.SSLError) as error:
        raise InvalidOption(f"ca_file {ca_file}: {error}") from None
