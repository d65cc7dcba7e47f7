"""The steps between `write` and the batch: the Coordinator's assignment and the assigned rate.

    item ──► BUFFER: held until the handshake ends     REFUSED: counted      UNWANTED: archive="always" only
        └──► OPEN ──► pacer ──► KeyWriter.put

Callers hold the key writer's lock.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec

from due.drivers.base import Publisher
from due.heartbeat_thread import HeartbeatThread
from due.key_writer import ARCHIVE, KeyWriter, Waiting
from due.membership import Verdict
from due.pacing import Pacer

_SHORTEST_VISIT = 0.001


class WriteAdmission:
    """Applies assignments to the key writers of one engine."""

    def __init__(self, keeper: HeartbeatThread, publisher: Publisher, hold_bytes: int) -> None:
        self._keeper = keeper
        self._publisher = publisher
        self._hold_bytes = hold_bytes
        self._changed = threading.Condition()
        self._held_bytes = 0
        self.failed: Callable[[], None] = lambda: None
        """Raises if no assignment can ever come; set by the session."""
        self.taken_back = 0
        """Items that `write` took, and that were refused when it was known which instance is active."""
        self.not_kept = 0
        """Refused items that were to be archived: more than a word that is repeated anyway."""
        self.lost = 0
        """Best-effort items for which there was no room while Data Updates could not be reached."""
        self.counts = {"unwanted": 0, "refused": 0, "held_for_permission": 0, "replaced": 0}

    def changed(self) -> None:
        """Assignments may have changed: wake waiting writers."""
        with self._changed:
            self._changed.notify_all()

    def write(self, outlet: KeyWriter, item: Waiting) -> bool:
        """Handle one item under the current assignments; see `Engine.write` for the result."""
        self.review(outlet)
        return self._place(outlet, item)

    def review(self, outlet: KeyWriter) -> None:
        """Apply the current assignments; releases items that were held for them."""
        if outlet.fast or outlet.retired:
            return
        outlet.fast = True
        with self._keeper.lock:
            permission = self._keeper.member.permission(outlet.key)
            outlet.epoch = self._keeper.member.epoch
        capability = permission.capability
        outlet.permission = permission
        outlet.reliable = capability is not None and capability.delivery == "reliable"
        outlet.index = capability is not None and capability.index
        self._set_pace(
            outlet, permission.frequency, queue=capability is not None and capability.pacing == "queue"
        )
        if permission.verdict is not Verdict.BUFFER and outlet.held:
            held, outlet.held = outlet.held, deque()
            self._held_bytes -= outlet.held_bytes
            outlet.held_bytes = 0
            if permission.verdict is Verdict.REFUSED:
                self.taken_back += sum(not item[1] & ARCHIVE for item in held)
            for item in held:
                self._place(outlet, item)
        if permission.verdict is not Verdict.OPEN or outlet.pacer is not None:
            outlet.fast = False

    def blocked(self, outlet: KeyWriter) -> bool:
        """Whether sending would wait for readers."""
        return outlet.reliable and not self._publisher.has_room(outlet.key.path)

    def service(self, outlet: KeyWriter, now: int) -> float | None:
        """A flush by the sender thread; returns seconds until the next, None: after the next write."""
        self.review(outlet)
        pacer = outlet.pacer
        while pacer is not None and (item := pacer.release(now)) is not None:
            _put(outlet, item)
        outlet.cut()
        due = pacer.due() if pacer is not None else None
        return None if due is None else max(_SHORTEST_VISIT, (due - now) / 1e9)

    def _place(self, outlet: KeyWriter, item: Waiting) -> bool:
        permission = outlet.permission
        verdict = permission.verdict
        if verdict is Verdict.BUFFER:
            return self._hold(outlet, item)
        if verdict is Verdict.REFUSED:
            self.counts["refused"] += 1
            self.not_kept += bool(item[1] & ARCHIVE)
            return False
        if verdict is Verdict.UNWANTED:
            self.counts["unwanted"] += 1
            capability = permission.capability
            if capability is not None and capability.archive == "always" and item[1] & ARCHIVE:
                outlet.put(item[0], ARCHIVE, item[3], item[4])
            return False
        if outlet.pacer is not None:
            return self._pace(outlet, outlet.pacer, item)
        _put(outlet, item)
        return True

    def _hold(self, outlet: KeyWriter, item: Waiting) -> bool:
        """Hold an item until the assignments are known; wait if too much is held already."""
        self.counts["held_for_permission"] += 1
        while self._held_bytes > self._hold_bytes:
            if not (outlet.reliable or self._keeper.connected):
                self.lost += 1
                return True
            with self._changed:
                self._changed.wait(0.05)
            self.failed()
            outlet.fast = False
            self.review(outlet)
            if outlet.permission.verdict is not Verdict.BUFFER:
                return self._place(outlet, item)
        size = _size(item[0])
        outlet.held.append(item)
        outlet.held_bytes += size
        self._held_bytes += size
        return True

    def _pace(self, outlet: KeyWriter, pacer: Pacer[Waiting], item: Waiting) -> bool:
        while pacer.full:
            time.sleep(min(0.05, 1 / pacer.frequency))
            released = pacer.release(time.time_ns())
            if released is not None:
                _put(outlet, released)
                outlet.cut()
        before = pacer.replaced
        leaves = pacer.offer(item, time.time_ns())
        self.counts["replaced"] += pacer.replaced - before
        if leaves is None:
            outlet.dirty()
        else:
            _put(outlet, leaves)
        return True

    def _set_pace(self, outlet: KeyWriter, frequency: float | None, *, queue: bool) -> None:
        old = outlet.pacer
        if old is not None and (old.frequency, old.queue) == (frequency, queue):
            return
        outlet.pacer = Pacer(frequency, queue=queue) if frequency else None
        for item in old.drain() if old is not None else ():
            if outlet.pacer is None:
                _put(outlet, item)
            else:
                self._pace(outlet, outlet.pacer, item)


def _put(outlet: KeyWriter, item: Waiting) -> None:
    value, mode, no_wait, event_time, now = item
    outlet.put(value, mode, event_time, now, stays=not no_wait)
    if no_wait:
        outlet.cut()


def _size(value: Any) -> int:
    if isinstance(value, bytes | str):
        return len(value)
    return memoryview(value).nbytes if isinstance(value, msgspec.Raw) else 16
