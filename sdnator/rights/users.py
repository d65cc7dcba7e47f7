"""People who may sign in to the dashboard: names, roles and hashes of passwords, in one file of mode 0600.

sdnator user add ──► users.json ──► the dashboard reads it at every sign-in
"""

import hashlib
import hmac
import re
import secrets
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import msgspec

from due.private_files import locked, private_folder, write_private
from sdnator.errors import BadInput

FILE = "users.json"
OWNER = "owner"
"""Who holds the token, or came by a link of `sdnator up`; no user may have this name."""
LEAST, MOST = 10, 256
"""Characters of a password."""
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_N, _R, _P = 1 << 15, 8, 1
_MEMORY = 64 << 20

UserRole = Literal["viewer", "operator"]


class PageUser(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One person."""

    role: UserRole
    """viewer: looks; operator: undoes and allows, too."""
    salt: bytes
    digest: bytes
    """scrypt (N=2^15, r=8, p=1) of the password."""
    changed: int
    """ns since the epoch."""


class Users:
    """Reads and writes the file.

    Args:
        folder: the state folder.

    Raises:
        BadInput: the file is damaged; it is not made anew, which would sign everybody out for good.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE
        self._users: dict[str, PageUser] = {}
        self._read = (0, 0)
        self.reread()

    def reread(self) -> None:
        """Take up what others have written.  Raises BadInput for a damaged file."""
        try:
            found = self.path.stat()
            stamp = (found.st_mtime_ns, found.st_ino)
            if stamp != self._read:
                self._users = msgspec.json.decode(self.path.read_bytes(), type=dict[str, PageUser])
                self._read = stamp
        except FileNotFoundError:
            self._users, self._read = {}, (0, 0)
        except (OSError, msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise BadInput(f"{self.path}: {error}; remove it, and add the users again") from None

    @property
    def all(self) -> Mapping[str, PageUser]:
        """By name."""
        return self._users

    def add(self, name: str, role: UserRole, password: str) -> None:
        """Raises BadInput for a name that is taken or cannot be one, or a weak password."""
        if not _NAME.fullmatch(name) or name == OWNER:
            raise BadInput(f"{name!r}: a name has 1 to 64 letters, digits, . _ and -, and is not {OWNER}")
        made = _hashed(role, password)
        with self._changing():
            if name in self._users:
                raise BadInput(f"there is a user {name}: `sdnator user passwd {name}` changes the password")
            self._users[name] = made

    def change_password(self, name: str, password: str) -> None:
        """Ends the user's sessions, too.  Raises BadInput where there is none of that name."""
        with self._changing():
            self._users[name] = _hashed(self._known(name).role, password)

    def remove(self, name: str) -> None:
        """Ends the user's sessions, too.  Raises BadInput where there is none of that name."""
        with self._changing():
            self._known(name)
            del self._users[name]

    def verified(self, name: str, password: str) -> PageUser | None:
        """The user with that password; takes as long for a name that nobody has.  About 0.1 s of CPU and 32 MiB."""
        found = self._users.get(name)
        salt = found.salt if found is not None else b"nobody"
        digest = _digest(password[: MOST + 1], salt)
        well = found is not None and hmac.compare_digest(digest, found.digest)
        return found if well else None

    def _known(self, name: str) -> PageUser:
        if name not in self._users:
            raise BadInput(f"there is no user {name}; `sdnator user list` shows all")
        return self._users[name]

    @contextmanager
    def _changing(self) -> Iterator[None]:
        try:
            private_folder(self.path.parent)
            with locked(self.path.with_suffix(".lock")):
                self.reread()
                self._users = dict(self._users)
                yield
                text = msgspec.json.format(msgspec.json.encode(self._users)).decode() + "\n"
                write_private(self.path, text)
                self._read = (0, 0)
        except OSError as error:
            raise BadInput(
                f"{self.path}: cannot be written ({error.strerror}); check its permissions"
            ) from None


def _hashed(role: UserRole, password: str) -> PageUser:
    if not LEAST <= len(password) <= MOST:
        raise BadInput(f"a password has {LEAST} to {MOST} characters")
    salt = secrets.token_bytes(16)
    return PageUser(role=role, salt=salt, digest=_digest(password, salt), changed=time.time_ns())


def _digest(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(
        password.encode("utf-8", "replace"), salt=salt, n=_N, r=_R, p=_P, maxmem=_MEMORY, dklen=32
    )
