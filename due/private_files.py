"""Files with secrets, readable by their owner only from the start."""

import json
import os
import secrets
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def write_private(path: Path, text: str) -> None:
    """Replace a file atomically, with mode 0600.  Raises OSError.

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
    new.replace(path)


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
