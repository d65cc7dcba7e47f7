"""Disk space that pruning is given where the disk is full: SQLite writes before it frees.

    archive.db-reserve    allocated while there is room, given up while a full disk is pruned, then allocated again

Deleting is written into the WAL, which can be written again only when all that is in it has found room in the file.
On file systems that copy on write (btrfs, ZFS) allocating promises nothing.
"""

import logging
import os
from contextlib import suppress
from pathlib import Path

from due.drivers.sqlite_file import WAL_BYTES

log = logging.getLogger("due.archive")


class PruningReserve:
    """The reserve of one archive.

    Args:
        archive: its file.
    """

    def __init__(self, archive: Path) -> None:
        self._path = archive.with_name(f"{archive.name}-reserve")
        self._warned = False

    def allocate(self) -> None:
        """Have it, if there is room."""
        with suppress(OSError):
            if self._path.stat().st_size >= WAL_BYTES:
                return
        try:
            number = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                os.posix_fallocate(number, 0, WAL_BYTES)
            finally:
                os.close(number)
        except OSError as error:
            # what was allocated of it so far would only be missing elsewhere
            self.give_up()
            if not self._warned:
                log.warning(
                    "%s, to prune the archive on a full disk, cannot be allocated: %s", self._path, error
                )
            self._warned = True
        else:
            self._warned = False

    def give_up(self) -> bool:
        """Free its space; whether there was any."""
        try:
            self._path.unlink()
        except OSError:
            return False
        return True
