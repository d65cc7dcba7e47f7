"""Files with secrets, readable by their owner only from the start."""

import fcntl
import json
import os
import secrets
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any


def write_private(path: Path, text: str) -> None:
    """Replace a file atomically, with mode 0600 and the owner that `give_to_owner` says.  Raises OSError.

    A file that holds the text already is left alone, so that a part can be restarted on a full disk.
    """
    if _holds(path, text):
        return
    new = path.with_name(path.name + ".new")
    # a stale temporary file may have another mode
    new.unlink(missing_ok=True)
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        file.write(text)
        give_to_owner(file.fileno(), path.parent)
    new.replace(path)


def give_to_owner(descriptor: int, folder: Path) -> None:
    """Give a file that root has just made in another user's folder to that user.

    Otherwise a service could no longer read what root's commands change for it.
    """
    if os.geteuid() == 0:
        owner = folder.stat()
        # root without CAP_CHOWN, or of a user namespace that does not know the owner
        with suppress(OSError):
            os.fchown(descriptor, owner.st_uid, owner.st_gid)


def private_folder(path: Path) -> None:
    """Make a folder of mode 0700 where there is none, and those above it; each has the owner of the one above.

    Raises OSError.
    """
    if path.is_dir():
        return
    private_folder(path.parent)
    path.mkdir(mode=0o700, exist_ok=True)
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        give_to_owner(descriptor, path.parent)
    finally:
        os.close(descriptor)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock in a file of the same folder, for which others wait.  Raises OSError."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        # no link: root would open what the folder's owner chose
        descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    else:
        give_to_owner(descriptor, path.parent)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _holds(path: Path, text: str) -> bool:
    try:
        state = path.lstat()
        return (
            stat.S_ISREG(state.st_mode)
            and stat.S_IMODE(state.st_mode) == 0o600
            and path.read_bytes() == text.encode()
        )
    except OSError:
        return False


def kept_secret(path: Path) -> str:
    """The secret in a file of mode 0600; made at the first call, and again if others can read the file.

    Raises OSError.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    try:
        if (
            stat.S_IMODE(path.lstat().st_mode) == 0o600
            and len(found := path.read_text("ascii").strip()) >= 16
        ):
            return found
    except (OSError, ValueError):
        pass
    made = secrets.token_urlsafe(24)
    write_private(path, made + "\n")
    return made


def write_private_json(path: Path, values: Mapping[str, Any]) -> str:
    """The same with a JSON object; returns the path as text."""
    write_private(path, json.dumps(values, indent=2) + "\n")
    return str(path)
