"""Writing to Data Archives: a bounded queue and one thread, so that archive writes do not block `write`.

    put ──► queue (bytes bounded) ──► thread ──► archive        batches of at least `archive_batch` items
                                        └──► spool ──► archive  while the archive is away

Policy: while the archive is away, frames go to disk up to the spool's size, beyond it they are lost and
counted; without a spool they wait.  Where the spool's disk takes nothing, as where a full disk holds both, they
go into the spool's reserve; without room there they wait as long as the queue has room, and are lost and counted
then.  Only when the queue is full, because archive and disk are slower than the writers, does `put` wait.  Nothing is lost silently: see `statistics`.
"""

import logging
import threading
import time
from collections import deque

from due.backoff import Backoff
from due.drivers.base import ArchiveDriver, Spool
from due.errors import ArchiveUnavailable, BackendError, DueError, Timeout
from due.logs import LogLimit
from due.messages import PackedFrame
from due.threads import Failed, LoudThread

log = logging.getLogger("due.archive")

_SPOOL_FRAMES = 64
_ADOPT_SECONDS = 5.0


class Archiver:
    """Writes frames to one archive in a thread of its own."""

    def __init__(
        self,
        archive: ArchiveDriver,
        spool: Spool | None = None,
        *,
        queue_bytes: int = 64 << 20,
        batch: int = 1000,
        linger: float = 0.02,
        failed: Failed | None = None,
    ) -> None:
        self._archive = archive
        self._spool = spool
        self._queue_bytes = queue_bytes
        self._batch = batch
        self._linger = linger
        self._queue: deque[PackedFrame] = deque()
        self._bytes = 0
        self._items = 0
        self._put = 0
        self._finished = 0
        self._urgent = False
        self._closing = False
        self._condition = threading.Condition()
        self._backoff = Backoff(0.1, 5.0)
        self._spool_backoff = Backoff(0.1, 5.0)
        self._away = False
        self._adopt_at = 0.0
        self._counts = {"archived": 0, "spooled": 0, "lost": 0, "refused": 0, "held_back": 0}
        self._failed = failed
        self._errors = LogLimit(log)
        self.turned = time.monotonic()
        """Start of the thread's last loop iteration, monotonic seconds."""
        self._thread = LoudThread("due-archiver", self._run, self._died)
        self._thread.start()

    def put(self, frame: PackedFrame) -> None:
        """Queue a frame; waits only while the queue is full."""
        with self._condition:
            while self._bytes > self._queue_bytes and not self._closing:
                self._counts["held_back"] += 1
                self._condition.wait(0.1)
            self._queue.append(frame)
            self._bytes += len(frame.payload)
            self._items += frame.count
            self._put += 1
            if self._items >= self._batch or self._put == self._finished + 1:
                self._condition.notify_all()

    def flush(self, timeout: float | None = None) -> None:
        """Return when all that was put is archived; or spooled or lost, which `statistics` counts.

        Raises `Timeout`.
        """
        with self._condition:
            goal = self._put
            self._urgent = True
            self._condition.notify_all()
            if not self._condition.wait_for(lambda: self._finished >= goal or self._closing, timeout):
                raise Timeout(f"Data Archives did not take {goal - self._finished} frames within {timeout} s")

    def backlog(self) -> int:
        """Frames that are neither archived nor lost."""
        return self._put - self._finished + (len(self._spool) if self._spool is not None else 0)

    def statistics(self) -> dict[str, int]:
        """Counters for `health`; items, but the backlog in frames."""
        damaged = self._spool.damaged if self._spool is not None else 0
        return {
            **self._counts,
            "backlog": self.backlog(),
            "away": int(self._away),
            "damaged_spools": damaged,
        }

    def close(self, timeout: float = 10.0) -> None:
        """Flush, at most `timeout` seconds, and stop the thread."""
        try:
            self.flush(timeout)
        except Timeout as error:
            log.error("%s: they are lost", error)  # noqa: TRY400 - no trace needed
        with self._condition:
            self._closing = True
            self._condition.notify_all()
        self._thread.join(timeout)
        if self._spool is not None:
            self._spool.close()

    def _died(self, error: BaseException) -> None:
        """The thread has died: release writers that wait for room in the queue."""
        with self._condition:
            self._closing = True
            self._counts["lost"] += sum(frame.count for frame in self._queue)
            self._condition.notify_all()
        if self._failed is not None:
            self._failed(error)

    def _run(self) -> None:
        while True:
            self.turned = time.monotonic()
            frames = self._next()
            if frames:
                self._store(frames)
                with self._condition:
                    self._finished += len(frames)
                    self._condition.notify_all()
            if self._closing and not self._queue:
                return
            try:
                self._drain_spool()
            except DueError as error:
                self._spool_failed(error)

    def _next(self) -> list[PackedFrame]:
        """Wait for a batch; returns [] from time to time so that the spool is emptied, too."""
        with self._condition:
            if not self._queue and not self._closing:
                self._condition.wait(0.0 if self._can_drain() else 0.2)
            if self._queue and not (self._urgent or self._closing or self._items >= self._batch):
                self._condition.wait(self._linger)
            frames, count = [], 0
            while self._queue and count < max(self._batch, 1):
                frames.append(self._queue.popleft())
                count += frames[-1].count
            self._bytes -= sum(len(f.payload) for f in frames)
            self._items -= count
            self._urgent = self._urgent and bool(self._queue)
            return frames

    def _store(self, frames: list[PackedFrame]) -> None:
        while not self._insert(frames):
            self.turned = time.monotonic()
            if self._spool is not None:
                lost = self._spooled(self._spool, frames)
                if lost is not None:
                    self._counts["lost"] += lost
                    self._counts["spooled"] += sum(f.count for f in frames) - lost
                    return
                if len(frames) > 1:  # some of them may fit into the spool's reserve
                    self._store(frames[: len(frames) // 2])
                    self._store(frames[len(frames) // 2 :])
                    return
            elif self._closing:
                self._counts["lost"] += sum(f.count for f in frames)
                return
            time.sleep(min(0.05, self._backoff.wait(time.monotonic())))

    def _spooled(self, spool: Spool, frames: list[PackedFrame]) -> int | None:
        """How many items did not fit; None: its disk takes nothing now, and there is room to wait."""
        try:
            return spool.put(frames)
        except BackendError as error:
            self._errors.error("%s", error)
            if self._closing or self._bytes > self._queue_bytes:
                return sum(f.count for f in frames)
            return None

    def _insert(self, frames: list[PackedFrame]) -> bool:
        """Store frames; False if another attempt may help."""
        if not self._backoff.due(time.monotonic()):
            return False
        count = sum(f.count for f in frames)
        try:
            self._archive.insert_frames(frames)
        except ArchiveUnavailable as error:
            delay = self._backoff.failed(time.monotonic())
            if not self._away:
                log.warning("Data Archives cannot be reached: %s; retrying in %.1f s", error, delay)
            self._away = True
            return False
        except (DueError, OverflowError, ValueError) as error:
            # one bad frame must not discard the rest of its batch; client libraries raise errors of their own
            # for numbers beyond 64 bits and for text that is not Unicode
            if len(frames) > 1:
                return all(self._insert([frame]) for frame in frames)
            self._counts["refused"] += count
            self._errors.error("Data Archives refused %d items of %s: %s", count, frames[0].key, error)
            return True
        if self._away:
            log.warning("Data Archives can be reached again")
        self._away = False
        self._backoff.succeeded()
        self._counts["archived"] += count
        return True

    def _can_drain(self) -> bool:
        now = time.monotonic()
        if self._spool is None or not (self._backoff.due(now) and self._spool_backoff.due(now)):
            return False
        return len(self._spool) > 0

    def _drain_spool(self) -> None:
        if self._spool is None:
            return
        now = time.monotonic()
        if now >= self._adopt_at and not self._away:
            self._adopt_at = now + _ADOPT_SECONDS
            self._spool.adopt()
        if not self._can_drain():
            return
        frames = self._spool.take(_SPOOL_FRAMES)
        if frames and self._insert(frames):
            self._spool.done(len(frames))
            self._spool_backoff.succeeded()

    def _spool_failed(self, error: DueError) -> None:
        """A broken disk must neither end the thread nor slow down the archive; frames in the spool stay there."""
        delay = self._spool_backoff.failed(time.monotonic())
        log.error("%s; retrying in %.1f s", error, delay)
