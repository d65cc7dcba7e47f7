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

    def __init__(self, heartbeats: HeartbeatThread, publisher: Publisher, hold_bytes: int) -> None:
        self._heartbeats = heartbeats
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
        """Items only to be published, for which there was no room while Data Updates could not be reached."""
        self.counts = {"unwanted": 0, "refused": 0, "held_for_permission": 0, "replaced": 0}

    def changed(self) -> None:
        """Assignments may have changed: wake waiting writers."""
        with self._changed:
            self._changed.notify_all()

    def write(self, writer: KeyWriter, item: Waiting) -> bool:
        """Handle one item under the current assignments; see `Engine.write` for the result."""
        self.review(writer)
        return self._place(writer, item)

    def review(self, writer: KeyWriter) -> None:
        """Apply the current assignments; releases items that were held for them."""
        if writer.fast or writer.retired:
            return
        writer.fast = True
        with self._heartbeats.lock:
            permission = self._heartbeats.member.permission(writer.key)
            writer.epoch = self._heartbeats.member.epoch
        capability = permission.capability
        writer.permission = permission
        writer.reliable = capability is not None and capability.delivery == "reliable"
        writer.index = capability is not None and capability.index
        self._set_pace(
            writer, permission.frequency, queue=capability is not None and capability.pacing == "queue"
        )
        if permission.verdict is not Verdict.BUFFER and writer.held:
            held, writer.held = writer.held, deque()
            self._held_bytes -= writer.held_bytes
            writer.held_bytes = 0
            if permission.verdict is Verdict.REFUSED:
                self.taken_back += sum(not item[1] & ARCHIVE for item in held)
            for item in held:
                self._place(writer, item)
        if permission.verdict is not Verdict.OPEN or writer.pacer is not None:
            writer.fast = False

    def blocked(self, writer: KeyWriter) -> bool:
        """Whether sending would wait for readers."""
        return writer.reliable and not self._publisher.has_room(writer.key.path)

    def service(self, writer: KeyWriter, now: int) -> float | None:
        """A flush by the sender thread; returns seconds until the next, None: after the next write."""
        self.review(writer)
        pacer = writer.pacer
        while pacer is not None and (item := pacer.release(now)) is not None:
            _put(writer, item)
        writer.cut()
        due = pacer.due() if pacer is not None else None
        return None if due is None else max(_SHORTEST_VISIT, (due - now) / 1e9)

    def _place(self, writer: KeyWriter, item: Waiting) -> bool:
        permission = writer.permission
        verdict = permission.verdict
        if verdict is Verdict.BUFFER:
            return self._hold(writer, item)
        if verdict is Verdict.REFUSED:
            self.counts["refused"] += 1
            self.not_kept += bool(item[1] & ARCHIVE)
            return False
        if verdict is Verdict.UNWANTED:
            self.counts["unwanted"] += 1
            capability = permission.capability
            if capability is not None and capability.archive == "always" and item[1] & ARCHIVE:
                writer.put(item[0], ARCHIVE, item[3], item[4])
            return False
        if writer.pacer is not None:
            return self._pace(writer, writer.pacer, item)
        _put(writer, item)
        return True

    def _hold(self, writer: KeyWriter, item: Waiting) -> bool:
        """Hold an item until the assignments are known; wait if too much is held already.

        Data Updates may be away for long, and the caller may be the dispatcher: items of best-effort keys do not wait then.
        """
        self.counts["held_for_permission"] += 1
        while self._held_bytes > self._hold_bytes:
            if not (writer.reliable or self._heartbeats.connected):
                if item[1] & ARCHIVE:  # whether this instance may archive it is not known
                    self.counts["refused"] += 1
                    self.not_kept += 1
                    return False
                self.lost += 1
                return True
            with self._changed:
                self._changed.wait(0.05)
            self.failed()
            writer.fast = False
            self.review(writer)
            if writer.permission.verdict is not Verdict.BUFFER:
                return self._place(writer, item)
        size = _size(item[0])
        writer.held.append(item)
        writer.held_bytes += size
        self._held_bytes += size
        return True

    def _pace(self, writer: KeyWriter, pacer: Pacer[Waiting], item: Waiting) -> bool:
        while pacer.full:
            time.sleep(min(0.05, 1 / pacer.frequency))
            released = pacer.release(time.time_ns())
            if released is not None:
                _put(writer, released)
                writer.cut()
        before = pacer.replaced
        leaves = pacer.offer(item, time.time_ns())
        self.counts["replaced"] += pacer.replaced - before
        if leaves is None:
            writer.dirty()
        else:
            _put(writer, leaves)
        return True

    def _set_pace(self, writer: KeyWriter, frequency: float | None, *, queue: bool) -> None:
        old = writer.pacer
        if old is not None and (old.frequency, old.queue) == (frequency, queue):
            return
        writer.pacer = Pacer(frequency, queue=queue) if frequency else None
        for item in old.drain() if old is not None else ():
            if writer.pacer is None:
                _put(writer, item)
            else:
                self._pace(writer, writer.pacer, item)


def _put(writer: KeyWriter, item: Waiting) -> None:
    value, mode, no_wait, event_time, now = item
    writer.put(value, mode, event_time, now, stays=not no_wait)
    if no_wait:
        writer.cut()


def _size(value: Any) -> int:
    if isinstance(value, bytes | str):
        return len(value)
    return memoryview(value).nbytes if isinstance(value, msgspec.Raw) else 16
