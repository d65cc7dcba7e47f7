"""Files with secrets, readable by their owner only from the start."""

import json
import os
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


def write_private_json(path: Path, values: Mapping[str, Any]) -> str:
    """The same with a JSON object; returns the path as text."""
    write_private(path, json.dumps(values, indent=2) + "\n")
    return str(path)
