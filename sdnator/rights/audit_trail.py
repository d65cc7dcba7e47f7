"""Keeps what was done on the command line in the audit trail, under the name of the Unix user who did it.

The archive may be away, or not be there yet: the deed is done all the same, and the command says what the trail lacks.
Whoever can run these commands may also write the archive: the trail is a memory, and no fence against its owner.
"""

import os
import pwd
import sys
import time
import uuid
from contextlib import closing

from sdnator.rights.audited_deed import COMMANDS, AuditedDeed

_SOURCE = "command line"
_LONGEST = 400


def note(deed: str, *, instruction: str = "", archive: str = "") -> None:
    """Keep a deed.

    Args:
        deed: what was done, in words that follow the name; never a password.
        instruction: id of the instruction that an app was given.
        archive: Data Archives URL; empty: $DUE_ARCHIVE, the running pipeline's, or that of `sdnator up`.
    """
    from due import DueError, Item
    from due.backends import open_archive
    from sdnator.errors import SdnatorError
    from sdnator.up.running import archive_url

    now = time.time_ns()
    done = AuditedDeed(who=unix_user(), deed=deed[:_LONGEST], source=_SOURCE, instruction=instruction)
    item = Item(COMMANDS, done.to_value(), now, now, "operator", uuid.uuid4().hex, 1)
    try:
        with closing(open_archive(archive_url(archive))) as driver:
            driver.insert([item])
    except (DueError, SdnatorError) as error:
        print(f"this is missing from the audit trail: {error}", file=sys.stderr)


def unix_user() -> str:
    """Whose command this is; the login that has become root by sudo is told, too."""
    own = _name(os.geteuid())
    before = os.environ.get("SUDO_UID", "")
    return f"{own} ({_name(int(before))})" if own == "root" and before.isdecimal() else own


def _name(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except (KeyError, OverflowError):
        return str(number)
