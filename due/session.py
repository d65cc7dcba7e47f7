"""The parts of an engine between `init` and `close`, wired together."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from due.archiver import Archiver
from due.backends import open_archive, open_spool, open_updates
from due.codec import packed
from due.config import Options
from due.dispatcher import Dispatcher
from due.drivers.base import ArchiveDriver, own_group
from due.drivers.embedded_redis import EmbeddedServer, shared_server
from due.errors import (
    BackendError,
    DueError,
    EngineFailed,
    InvalidOption,
    Superseded,
    Timeout,
    UpdatesUnavailable,
)
from due.heartbeat_thread import HeartbeatThread
from due.key_writer import ARCHIVE, PUBLISH, KeyWriter, Sent
from due.keys import Key
from due.liveness import Liveness
from due.logs import without_passwords
from due.membership import MOST_DECLARED, Member, Registration
from due.messages import Assignment, AssignmentCallback, Capability, Interest
from due.observation import Observation
from due.sender import BatchSender
from due.shards import ShardState, ShardWork
from due.struct_types import learn_struct_types
from due.threads import Failed
from due.write_admission import WriteAdmission

log = logging.getLogger("due")

_KEYS_SHOWN = 32
_MOST_WRITERS = 10_000
"""With more keys than this, idle key writers are removed."""


class Session:
    """The parts, their start and their end."""

    def __init__(
        self,
        options: Options,
        registration: Registration,
        *,
        updates_url: str,
        archive_url: str,
        failed: Failed,
        shards: tuple[str, ...] = (),
    ) -> None:
        self._options = options
        self.failure: BaseException | None = None
        """The exception that killed a thread."""
        self._tell_failure = failed
        self._server: EmbeddedServer | None = None
        if not updates_url:
            updates_url, self._server = shared_server(options.folder())
        self.updates_url = updates_url
        self._driver = open_updates(updates_url, options)
        app, me = registration.app_id, registration.instance_id
        self.publisher = self._driver.publisher(app)
        shared = registration.instances == "shared"
        # with shards of its own an app's reliable paths are not divided: every instance reads all of them
        receiver = self._driver.receiver(own_group(app, me) if shards else app, me, shared=shared)
        self.dispatcher = Dispatcher(receiver, shared=shared, tries=options.tries, failed=self._died)
        member = Member(
            registration,
            now=time.monotonic(),
            handshake_timeout=options.handshake_timeout,
            coordinated=options.coordinated,
            named=shards,
        )
        control, pause = self._driver.receiver(app, me), options.pause_limit or 3 * options.heartbeat
        self.heartbeats = HeartbeatThread(
            member, control, self.publisher, self.dispatcher, pause=pause, failed=self._died
        )
        if registration.instances == "sharded" and not shards:
            self.dispatcher.shards = ShardWork(receiver, self.dispatcher.tracker, self.heartbeats)
        self.heartbeats.say, self.heartbeats.changed = self._say, self._changed
        self.heartbeats.written = self._written
        self.admission = WriteAdmission(self.heartbeats, self.publisher, options.handshake_bytes)
        self.admission.failed = self.check
        self.sender = BatchSender(options.linger, self.admission.service, self.admission.blocked, self._died)
        self.writers: dict[str, KeyWriter] = {}
        """By canonical key."""
        self.retirements = 0
        """How often idle key writers were removed."""
        self._retired: dict[str, tuple[int, int]] = {}
        """By key: items numbered and published by removed key writers."""
        self._retired_items = 0
        self._said: dict[str, KeyWriter] = {}
        self._observed: list[Observation] = []
        self._declared = registration.interests
        self._archiver: Archiver | None = None
        self.liveness = Liveness(self.dispatcher, self.heartbeats, lambda: self._archiver)
        self._archive: ArchiveDriver = open_archive(archive_url)
        self._lock = threading.RLock()
        self._unpublished = 0
        self._acknowledged = 0
        """Items written when `flush` last succeeded."""
        self._superseded = 0
        self._told: tuple[Assignment, ...] | None = None
        self._callback: AssignmentCallback | None = None

    def start(self) -> None:
        """Start the threads and register; raises `UpdatesUnavailable`."""
        try:
            self.publisher.settle(self._options.connect_timeout)
        except Timeout:
            self.publisher.close()
            raise UpdatesUnavailable(
                f"Data Updates at {without_passwords(self._driver.url)} could not be reached within "
                f"{self._options.connect_timeout:g} s: start the server, or give another URL"
            ) from None
        learn_struct_types()
        self.sender.start()
        self.heartbeats.start()
        self.dispatcher.start()
        always = any(each.archive == "always" for each in self.heartbeats.member.registration.capabilities)
        if always or any(self._spool_folder().glob("spool*.db")):
            # at once: an earlier instance left frames in the spool, or a full disk would give no reserve later
            try:
                self._open_archiver()
            except BackendError as error:
                log.warning("%s; trying again with the first item to be archived", error)

    def check(self) -> None:
        """Raise `EngineFailed` if a thread has died."""
        if self.failure is not None:
            raise EngineFailed(
                f"a thread of the engine died of {type(self.failure).__name__}: {self.failure} (see the log); "
                "close() it and call init() again"
            ) from self.failure

    def _died(self, error: BaseException) -> None:
        if self.failure is None:
            self.failure = error
            self._tell_failure(error)
            self.dispatcher.halt()

    def writer(self, key: Key) -> KeyWriter:
        """The key writer of a key."""
        with self._lock:
            writer = self.writers.get(key.text)
            if writer is None:
                if len(self.writers) >= _MOST_WRITERS:
                    self._retire_writers()
                writer = self._new_writer(key)
                writer.sequence, writer.published = self._retired.pop(key.text, (0, 0))
                self._retired_items -= writer.sequence
                self.writers[key.text] = writer
            return writer

    def _retire_writers(self) -> None:
        """Remove idle key writers, but not their numbers: readers would take new ones for repeats."""
        for text, writer in list(self.writers.items()):
            numbers = writer.retire()
            if numbers is not None:
                del self.writers[text]
                self._retired[text] = numbers
                self._retired_items += numbers[0]
        self.retirements += 1

    def _written(self) -> int:
        return self._retired_items + sum(writer.sequence for writer in list(self.writers.values()))

    def _busiest(self) -> dict[str, int]:
        """Items by key without specs, for the keys with most writes."""
        counts: Counter[str] = Counter()
        for writer in list(self.writers.values()):
            counts[writer.key.path] += writer.sequence
        return dict(counts.most_common(_KEYS_SHOWN))

    def flush_writer(self, writer: KeyWriter) -> bool:
        """Send what is buffered; False while items wait for an assignment or for their rate."""
        with writer.lock:
            self.admission.review(writer)
            writer.cut()
            return not writer.held and (writer.pacer is None or writer.pacer.due() is None)

    def flush(self, timeout: float) -> None:
        """See `Engine.flush`."""
        deadline = time.monotonic() + timeout
        for writer in list(self.writers.values()):
            while not self.flush_writer(writer):
                self.check()
                if time.monotonic() > deadline:
                    raise Timeout(
                        f"{writer.key} still waits for an assignment or for its rate after {timeout} s"
                    )
                time.sleep(0.005)
        self.publisher.settle(max(0.1, deadline - time.monotonic()))
        if self._archiver is not None:
            self._archiver.flush(max(0.1, deadline - time.monotonic()))
        self._check_place()

    def _check_place(self) -> None:
        """Raise `Superseded` if readers may have refused what was written since the last successful flush."""
        written = self._written() + self.admission.taken_back + self.admission.not_kept
        since, self._acknowledged = written - self._acknowledged, written
        superseded = self.heartbeats.superseded
        lost_place, self._superseded = superseded > self._superseded, superseded
        if lost_place and since:
            raise Superseded(
                f"another instance took over from this one; readers may have refused some of the last {since} items "
                "written"
            )

    @property
    def active(self) -> bool:
        """See `Engine.active`."""
        with self.heartbeats.lock:
            return self.heartbeats.member.reading

    @property
    def connected(self) -> bool:
        """See `Engine.connected`."""
        return self.heartbeats.connected and self.dispatcher.receiver.connected

    def flush_archive(self, timeout: float) -> None:
        """Wait until this engine's writes are in the archive."""
        for writer in list(self.writers.values()):
            self.flush_writer(writer)
        if self._archiver is not None:
            self._archiver.flush(timeout)

    @property
    def archive(self) -> ArchiveDriver:
        """Data Archives."""
        return self._archive

    def tend(self) -> None:
        """See `Engine.tend`."""
        # an archive that is away is told of where it is needed
        with suppress(BackendError):
            self._archive.tend()

    def opened(self, observation: Observation) -> None:
        """An observation got its first subscriber."""
        self.check()
        with self._lock:
            self._observed.append(observation)
        # before: a producer that speaks only when something changes answers the interest once
        self.dispatcher.open(observation)
        self._declare_interests()

    def closed(self, observation: Observation) -> None:
        """An observation lost its last subscriber."""
        with self._lock:
            self._observed.remove(observation)
        self._declare_interests()
        self.dispatcher.shut(observation)

    def declare(
        self, interests: tuple[Interest, ...] | None, capabilities: tuple[Capability, ...] | None
    ) -> None:
        """See `Engine.declare`."""
        self.check()
        if len(interests or ()) > MOST_DECLARED or len(capabilities or ()) > MOST_DECLARED:
            raise InvalidOption(f"declare: at most {MOST_DECLARED} interests and capabilities")
        if capabilities is not None:
            with self.heartbeats.lock:
                self.heartbeats.member.declare(time.monotonic(), capabilities=capabilities)
            self._changed()
        if interests is not None:
            with self._lock:
                self._declared = interests
            self._declare_interests()
        self.heartbeats.wake()

    def keep_state(self, state: ShardState, every: float) -> None:
        """See `Engine.keep_state`."""
        self.check()
        if self.dispatcher.shards is None:
            raise InvalidOption(
                'keep_state is for apps with instances="sharded" whose shards are reliable paths'
            )
        if self._observed:
            raise InvalidOption("keep_state comes before the first subscription")
        self.dispatcher.shards.keep(state, every)

    def on_assignments(self, callback: AssignmentCallback) -> None:
        """See `Engine.on_assignments`."""
        self._callback = callback
        self._tell()

    def health(self) -> dict[str, Any]:
        """See `Engine.health`."""
        member = self.heartbeats.member
        health: dict[str, Any] = {
            "app": member.registration.app_id,
            "instance": member.registration.instance_id,
            "failed": self.failure is not None,
            "phase": member.phase.value,
            "active": member.active,
            "asking": member.asking,
            "epoch": member.epoch,
            "written": self.heartbeats.written(),
            "unpublished": self._unpublished + self.admission.lost,
            "key_writers": len(self.writers),
            "keys": self._busiest(),
            **self.admission.counts,
            "updates": self.publisher.statistics(),
            "receiving": self.dispatcher.statistics(),
            "misunderstood_assignments": self.heartbeats.misunderstood,
            "liveness": self.liveness.state(),
            "damaged_rows": self._archive.damaged,
        }
        if self._archiver is not None:
            health["archive"] = self._archiver.statistics()
        return health

    def close(self) -> None:
        """Stop everything, in the order in which data flows; pending writes are sent first."""
        self.dispatcher.close()
        with _reported("what was written last could not be sent"):
            self.flush(5.0)
        self.sender.close()
        self.heartbeats.close()
        with _reported("the goodbye could not be sent"):
            self.publisher.settle(1.0)
        self.publisher.close()
        if self._archiver is not None:
            self._archiver.close()
        self._archive.close()
        self._driver.close()
        if self._server is not None:
            self._server.stop()

    def _new_writer(self, key: Key) -> KeyWriter:
        registration = self.heartbeats.member.registration
        return KeyWriter(
            key,
            registration.app_id,
            registration.instance_id,
            frame_bytes=self._options.frame_bytes,
            single_bytes=self._options.single_bytes,
            sink=self._sink,
            dirty=self.sender.dirty,
        )

    def _sink(self, writer: KeyWriter, sent: list[Sent], mode: int) -> None:
        if mode & PUBLISH:
            self._publish(writer, sent)
        if mode & ARCHIVE:
            archiver = self._archiver or self._open_archiver()
            for frame, payload in sent:
                archiver.put(packed(frame, payload, index=writer.index))

    def _publish(self, writer: KeyWriter, sent: list[Sent]) -> None:
        if writer.reliable:
            for _, payload in sent:
                self.publisher.append(writer.key.path, payload)
            return
        try:
            self.publisher.publish(writer.key.path, *(payload for _, payload in sent))
        except UpdatesUnavailable:
            self._unpublished += sum(len(frame.timestamps) for frame, _ in sent)

    def _open_archiver(self) -> Archiver:
        with self._lock:
            if self._archiver is None:
                o = self._options
                spool = open_spool(self._spool_folder(), o)
                self._archiver = Archiver(
                    self._archive,
                    spool,
                    queue_bytes=o.archive_queue_bytes,
                    batch=o.archive_batch,
                    linger=o.archive_linger,
                    failed=self._died,
                )
            return self._archiver

    def _spool_folder(self) -> Path:
        return self._options.folder() / "spool" / self.heartbeats.member.registration.app_id

    def _say(self, text: str, value: object) -> None:
        """Write a membership message, regardless of assignments."""
        writer = self._said.get(text)
        if writer is None:
            writer = self._said[text] = self._new_writer(Key(text))
        with writer.lock:
            writer.put(value, PUBLISH, None, time.time_ns(), stays=False)
            writer.cut()

    def _changed(self) -> None:
        """Permissions may have changed."""
        for writer in list(self.writers.values()):
            writer.fast = False
            self.sender.hurry(writer)
        self.admission.changed()
        self._tell()

    def _tell(self) -> None:
        callback = self._callback
        if callback is None:
            return
        with self.heartbeats.lock:
            if self.heartbeats.member.asking:
                return  # suspended for a moment: no assignment was withdrawn
            wanted = self.heartbeats.member.assignments
        if wanted != self._told:
            self._told = wanted
            self.dispatcher.post(lambda: callback(wanted))

    def _declare_interests(self) -> None:
        with self._lock:
            observed = tuple(Interest(o.key.text, o.frequency) for o in self._observed)
        interests = tuple(dict.fromkeys((*self._declared, *observed)))
        with self.heartbeats.lock:
            member = self.heartbeats.member
            if interests == member.registration.interests:
                return
            member.declare(time.monotonic(), interests=interests)
        self.heartbeats.wake()


@contextmanager
def _reported(what: str) -> Iterator[None]:
    try:
        yield
    except DueError as error:
        log.error("%s: %s", what, error)  # noqa: TRY400 - no trace needed
