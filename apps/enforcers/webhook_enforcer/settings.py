"""Options of the enforcer `webhook_enforcer`."""

from ipaddress import ip_address
from typing import Final
from urllib.parse import urlsplit

import msgspec

_LOWEST: Final = 0.1


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the enforcer."""

    url: str = ""
    """Where blocks are posted to and listed from: https://…, or http://… on this machine."""
    place: str = ""
    """Name of what it enforces, in keys and on the dashboard; empty: the host of the URL."""
    secret_file: str = ""
    """File with the secret that signs requests, at least 16 bytes, readable by its owner only."""
    ca_file: str = ""
    """CA certificates that may have signed the server's, PEM; empty: the system's."""
    timeout_s: float = 5.0
    """Seconds for one request and its answer."""
    check_s: float = 30.0
    """Seconds between two listings; what is missing is posted again, what should not be in force is lifted."""
    patience_s: float = 60.0
    """Seconds of attempts after which a block is answered as failed."""
    queue: int = 10_000
    """Decisions that may wait; further ones are answered as failed."""

    def __post_init__(self) -> None:
        if self.url:
            check_url(self.url)
            if not self.secret_file:
                raise ValueError("secret_file: name a file with the secret that signs requests")
        for name in ("timeout_s", "check_s", "patience_s"):
            if not getattr(self, name) >= _LOWEST:
                raise ValueError(f"{name}={getattr(self, name)}: must be at least {_LOWEST} s")
        if self.queue < 1:
            raise ValueError(f"queue={self.queue}: must be at least 1")


def check_url(url: str) -> None:
    """Raises ValueError for a URL that is none, holds a password, or would send decisions in the clear."""
    parts = urlsplit(url)
    if parts.username or parts.password:
        raise ValueError("url: it holds a password; requests are signed with the secret of secret_file")
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise ValueError(f"url {url!r}: give https://HOST/PATH")
    if parts.scheme == "http" and not _is_here(parts.hostname):
        raise ValueError(f"url {url!r}: http is for this machine (127.0.0.1) only; give https://…")


def _is_here(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
