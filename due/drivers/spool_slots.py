"""Spools of the instances of one app in one folder: each instance has its own, and none is left unread.

    spool.db  spool.lock      the first instance's      spool-1.db  spool-1.lock   the second's …

An instance owns the spool whose lock it holds; the lock ends with its process.  So a restarted app finds
its former spool free and goes on with it, and `adopt` takes over what others of the app left behind.
"""

import fcntl
import logging
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from due.drivers.spool_reserve import ReservedSpool
from due.errors import BackendError
from due.messages import PackedFrame

log = logging.getLogger("due.spool")

_SLOTS = 1000


class SlottedSpool:
    """`Spool` of one instance; raises BackendError if no spool can be opened in the folder."""

    def __init__(self, folder: Path, limit: int, reserve: int = 0) -> None:
        self._folder = folder
        self._limit = limit
        self._reserve = reserve
        self._adopted: list[_Slot] = []
        self._taken_from: ReservedSpool | None = None
        self._damaged_before = 0
        """Of spools that were adopted and are empty now."""
        self._own = self._first_free()

    def put(self, frames: Sequence[PackedFrame]) -> int:
        """Append to our own; returns how many items did not fit and are lost."""
        return self._own.spool.put(frames)

    def take(self, frames: int) -> list[PackedFrame]:
        """Up to `frames` of the oldest frames of one spool, adopted ones first; they stay until `done`."""
        self._taken_from = next((slot.spool for slot in self._adopted if len(slot.spool)), self._own.spool)
        return self._taken_from.take(frames)

    def done(self, frames: int) -> None:
        """Remove that many of the frames that `take` returned; an adopted spool is deleted when empty."""
        (self._taken_from or self._own.spool).done(frames)
        for slot in [slot for slot in self._adopted if not len(slot.spool)]:
            self._adopted.remove(slot)
            self._remove(slot)

    def adopt(self) -> None:
        """Take over the spools of instances that have ended; allocate a reserve that found no room before."""
        self._own.spool.allocate()
        names = {path.stem for path in self._folder.glob("spool*.db")} - {self._own.name}
        for name in sorted(names - {slot.name for slot in self._adopted}):
            slot = self._try(name)
            if slot is None:
                continue
            if len(slot.spool):
                log.warning("archiving %d frames that another instance left in %s", len(slot.spool), name)
                self._adopted.append(slot)
            else:
                self._remove(slot)

    @property
    def damaged(self) -> int:
        """See `Spool.damaged`."""
        return self._damaged_before + sum(slot.spool.damaged for slot in (self._own, *self._adopted))

    def _remove(self, slot: "_Slot") -> None:
        self._damaged_before += slot.spool.damaged
        slot.remove()

    def __len__(self) -> int:
        return len(self._own.spool) + sum(len(slot.spool) for slot in self._adopted)

    def close(self) -> None:
        """Close files; what is in them stays for the next start."""
        for slot in (self._own, *self._adopted):
            if slot.closed or len(slot.spool):
                slot.close()
            else:
                slot.remove()

    def _first_free(self) -> "_Slot":
        for number in range(_SLOTS):
            slot = self._try(f"spool-{number}" if number else "spool")
            if slot is not None:
                return slot
        raise BackendError(f"all {_SLOTS} spools in {self._folder} are in use; name another folder")

    def _try(self, name: str) -> "_Slot | None":
        """The spool of this name, unless another instance owns it."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            lock = os.open(self._folder / f"{name}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise BackendError(f"spool in {self._folder}: {error}; name another folder") from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return _Slot(name, lock, ReservedSpool(self._folder, self._limit, name, self._reserve))
        except BlockingIOError:
            os.close(lock)
            return None
        except BaseException:
            os.close(lock)
            raise


class _Slot:
    """One spool and its lock."""

    def __init__(self, name: str, lock: int, spool: ReservedSpool) -> None:
        self.name = name
        self.spool = spool
        self._lock = lock
        self.closed = False

    def remove(self) -> None:
        """Delete an empty spool.  The lock's file stays; otherwise two could hold locks of one name."""
        self.spool.close()
        for suffix in (".db", ".db-wal", ".db-shm", ".reserve"):
            with suppress(OSError):
                self.spool.path.with_suffix(suffix).unlink()
        self.close()

    def close(self) -> None:
        """Close the spool and release the lock."""
        if not self.closed:
            self.closed = True
            self.spool.close()
            os.close(self._lock)
