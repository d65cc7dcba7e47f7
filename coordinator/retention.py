"""Keeping the archive within an age and a size: the active Coordinator prunes it now and then."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from due.drivers.base import ArchiveDriver
from due.drivers.lasting import Lasting
from due.errors import DueError

log = logging.getLogger("coordinator.retention")


class Retention:
    """Prunes in a thread of its own, since a large archive takes a while.  0 means no limit."""

    def __init__(
        self,
        open_archive: Callable[[], ArchiveDriver],
        allowed: Callable[[], bool],
        *,
        age_s: float,
        max_bytes: int,
        every_s: float,
        lasting_keys: Sequence[str] = (),
        lasting_age_s: float = 0.0,
    ) -> None:
        self._open_archive = open_archive
        self._allowed = allowed
        self._age_s = age_s
        self._max_bytes = max_bytes
        self._every_s = every_s
        self._lasting_keys = tuple(lasting_keys)
        self._lasting_age_s = lasting_age_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="coordinator-retention", daemon=True)
        self.deleted = 0
        """Items deleted so far."""

    def start(self) -> None:
        """Start the thread if there is a limit."""
        if self._age_s > 0 or self._max_bytes > 0 or self._lasting_age_s > 0:
            self._thread.start()

    def stop(self) -> None:
        """Stop; a running prune is finished first."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        archive = self._open_archive()
        while not self._stop.wait(self._every_s):
            if self._allowed():
                self._prune(archive)
            else:
                with suppress(DueError):
                    archive.tend()
        archive.close()

    def _prune(self, archive: ArchiveDriver) -> None:
        lasting = Lasting(self._lasting_keys, _ago(self._lasting_age_s))
        try:
            deleted = archive.prune(
                before=_ago(self._age_s), max_bytes=self._max_bytes or None, lasting=lasting
            )
        except DueError as error:
            log.warning("the archive could not be pruned: %s; retrying in %g s", error, self._every_s)
            return
        self.deleted += deleted
        if deleted:
            log.info("deleted %d items that exceeded the archive's limit of age or size", deleted)


def _ago(seconds: float) -> int | None:
    """That moment, ns since the epoch; None for 0."""
    return time.time_ns() - int(seconds * 1e9) if seconds > 0 else None
