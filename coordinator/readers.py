"""Apps that may read from the archive over HTTP, each its keys: a file that `sdnator` writes.

readers.json: {app: {"digest": SHA-256 of its password, "read": [key patterns]}}   ──► GET /get, with these keys only
"""

import hashlib
import hmac
import logging
from pathlib import Path
from typing import Any

import msgspec

from due.drivers.redis_rights import covers
from due.errors import InvalidKey
from due.keys import Key

log = logging.getLogger("coordinator.api")

_MOST_BYTES = 4 << 20
_NEVER, _DAMAGED = (0, 0), (-1, -1)


class ArchiveReader(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One app."""

    digest: str
    """SHA-256 of its password, hexadecimal; passwords are random, so that no slow hash is needed."""
    read: tuple[str, ...] = ()
    """Key patterns."""

    def __post_init__(self) -> None:
        for pattern in self.read:
            try:
                Key.parse(pattern)
            except InvalidKey as error:
                raise ValueError(str(error)) from None

    def may_read(self, key: str) -> bool:
        """Whether everything of a key, or of a pattern, may be read; specs do not count.

        Raises:
            InvalidKey: it is none.
        """
        return any(covers(pattern, key) for pattern in self.read)

    def narrowed(self, query: dict[str, Any]) -> dict[str, Any]:
        """The query, without what may not be read."""
        return {"$and": [query, {"$or": [{"dataKey": pattern} for pattern in self.read]}]}


class ArchiveReaders:
    """Knows them by their passwords; reads the file again when it has changed.

    Args:
        path: of the file; None, or a file that is missing or damaged: nobody.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._stamp = _NEVER
        self._readers: dict[str, ArchiveReader] = {}

    def of(self, password: bytes) -> tuple[str, ArchiveReader] | None:
        """Name and rights of whoever has this password."""
        self._look()
        digest = hashlib.sha256(password).hexdigest()
        found = None
        for name, reader in self._readers.items():
            if hmac.compare_digest(reader.digest.encode(), digest.encode()):
                found = (name, reader)
        return found

    def _look(self) -> None:
        if self._path is None:
            return
        try:
            seen = self._path.stat()
            stamp = (seen.st_mtime_ns, seen.st_ino)
            if stamp != self._stamp:
                self._readers, self._stamp = _read(self._path), stamp
        except FileNotFoundError:
            self._readers, self._stamp = {}, _NEVER
        except (OSError, msgspec.MsgspecError, ValueError, RecursionError) as error:
            if self._stamp != _DAMAGED:
                log.warning("%s: no app may read from the archive now: %s", self._path, error)
            self._readers, self._stamp = {}, _DAMAGED


def _read(path: Path) -> dict[str, ArchiveReader]:
    with path.open("rb") as file:
        text = file.read(_MOST_BYTES + 1)
    if len(text) > _MOST_BYTES:
        raise ValueError(f"the file has more than {_MOST_BYTES:,} bytes")
    return msgspec.json.decode(text, type=dict[str, ArchiveReader])
