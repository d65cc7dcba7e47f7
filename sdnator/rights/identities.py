"""The identities of one installation: a user of Data Updates and a password for each app, kept in one file.

    identities.json (0600) ──► users_file(): rules of the embedded server
                          ├──► readers.json: who may read what from the archive over HTTP
                          └──► rules():      ACL SETUSER on a given one
                          └──► url(app):     what the app's own 0600 file holds

User names carry the installation's number, so that several installations can share a server.
"""

import hashlib
import json
import re
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from due.drivers.redis_rights import Rights, acl_rules
from due.drivers.redis_wire import as_user
from due.keys import Key
from due.private_files import locked, private_folder, write_private
from sdnator.errors import BadInput
from sdnator.rights.granting import OPERATOR, operator

FILE = "identities.json"
READERS = "readers.json"
ADMIN = "admin"
"""AppIdentity that makes the others on the embedded server."""
_PROBE = "user default on nopass resetkeys resetchannels clearselectors -@all +ping"
"""Without a credential one learns whether the server answers, and nothing else."""
_APP_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")


class AppIdentity(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One user of Data Updates."""

    password: str
    rights: Rights
    enrolled: bool = False
    """Made by `sdnator app enrol`, for an app that the pipeline does not start."""


class _Book(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    installation: str
    identities: dict[str, AppIdentity]


class Identities:
    """Reads and writes the file; made anew where it is damaged, which ends the enrolment of outside apps.

    Args:
        folder: the state folder.

    Raises:
        BadInput: the file is there, but cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE
        self._book = _Book(installation=secrets.token_hex(4), identities={})
        self.reread()

    def reread(self) -> None:
        """Take up what others have written.  Raises BadInput for a file that cannot be read."""
        try:
            self._book = msgspec.json.decode(self.path.read_bytes(), type=_Book)
        except FileNotFoundError:
            return
        except OSError as error:
            # it may be whole: new identities would lock out everybody who was enrolled
            raise BadInput(
                f"{self.path}: cannot be read ({error.strerror}); "
                "use sudo, or give the file to the user who runs the pipeline (chown)"
            ) from None
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return  # every identity that is needed is made again

    @contextmanager
    def changing(self) -> Iterator[None]:
        """Reread, change, write; nobody else changes the file meanwhile.  Raises BadInput for the folder."""
        try:
            private_folder(self.path.parent)
            with locked(self.path.with_suffix(".lock")):
                self.reread()
                yield
                write_private(self.path, msgspec.json.format(msgspec.json.encode(self._book)).decode() + "\n")
                write_private(self.path.with_name(READERS), json.dumps(self._readers()) + "\n")
        except OSError as error:
            raise BadInput(
                f"{self.path}: cannot be written ({error.strerror}); check its permissions"
            ) from None

    def put(self, name: str, rights: Rights, *, enrolled: bool = False) -> AppIdentity:
        """Give an identity these rights; its password stays.  Only while `changing`."""
        if not _APP_ID.fullmatch(name):
            raise BadInput(f"{name!r}: an app id has 1 to 64 letters, digits, _ and -")
        known = self._book.identities.get(name)
        password = known.password if known is not None else secrets.token_urlsafe(24)
        made = AppIdentity(password=password, rights=rights, enrolled=enrolled)
        self._book.identities[name] = made
        return made

    def remove(self, name: str) -> None:
        """Forget an identity.  Only while `changing`."""
        self._book.identities.pop(name, None)

    def keep_only(self, names: set[str]) -> None:
        """Forget identities of apps that are started no more; enrolled ones stay.  Only while `changing`."""
        self._book.identities = {
            name: one for name, one in self._book.identities.items() if one.enrolled or name in names
        }

    @property
    def all(self) -> Mapping[str, AppIdentity]:
        """By name; the administrator is not among them."""
        return self._book.identities

    @property
    def prefix(self) -> str:
        """What the users' names on the server begin with."""
        return f"sdnator-{self._book.installation}-"

    def url(self, server: str, name: str) -> str:
        """The URL of a server with an identity's user and password."""
        return as_user(server, self.prefix + name, self._book.identities[name].password)

    def _readers(self) -> dict[str, Any]:
        return {
            name: {
                "digest": _digest(one.password),
                "read": sorted({Key.parse(pattern).path for pattern in one.rights.read}),
            }
            for name, one in sorted(self._book.identities.items())
            if one.rights.read and name != OPERATOR
        }

    def rules(self, name: str) -> list[str]:
        """Arguments of `ACL SETUSER` for an identity."""
        one = self._book.identities[name]
        return [self.prefix + name, "on", "resetpass", f"#{_digest(one.password)}", *acl_rules(one.rights)]

    def users_file(self, admin_password: str) -> str:
        """The ACL file of the embedded server."""
        admin = f"user {self.prefix}{ADMIN} on #{_digest(admin_password)} allkeys allchannels allcommands"
        users = (" ".join(("user", *self.rules(name))) for name in self._book.identities)
        return "\n".join((_PROBE, admin, *users)) + "\n"


def _digest(password: str) -> str:
    return hashlib.sha256(password.encode()).hexdigest()


def credential_file(url: str, archive: str, identity: AppIdentity) -> dict[str, Any]:
    """What an app's options of the engine say about its identity."""
    places = {"updates": url, **({"archive": archive} if archive else {})}
    return {**places, **observable(identity.rights)}


def observable(rights: Rights) -> dict[str, Any]:
    """The option of the engine that says what may be observed."""
    return {} if rights.app == "*" else {"observable": list(rights.observe)}


def made(folder: Path, rights: Mapping[str, Rights]) -> Identities:
    """The identities of a pipeline's apps and of the user who starts it."""
    found = Identities(folder)
    with found.changing():
        found.keep_only({OPERATOR, *rights})
        found.put(OPERATOR, operator())
        for name, one in rights.items():
            found.put(name, one)
    return found


__all__ = ["AppIdentity", "Identities", "credential_file", "made", "observable"]
