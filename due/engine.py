"""The engine: the object through which an app writes and receives data.

    write ──► WriteAdmission ──► KeyWriter (numbers, batches) ──► driver ──► Data Updates    sender thread
                 ▲                                         └────► Archiver ─► Data Archives  archiver thread
                 │ assignments, rates
             Membership ◄── HeartbeatThread (heartbeats, assignments, leases)                heartbeat thread

    observe ──► Observation ◄── Dispatcher ◄── driver ◄── Data Updates                       dispatcher thread

`Engine` is the public API; `Session` holds the parts between `init` and `close`.
"""

import atexit
import os
import re
import socket
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from typing import Any, get_args
from uuid import uuid4

import msgspec

from due.backends import default_archive, default_updates
from due.clock import awake_ns
from due.codec import MAX_ID, checked_time, freeze, unpack
from due.config import Options
from due.errors import BackendError, DecodeError, InvalidKey, InvalidOption, NotAllowed, NotInitialised
from due.key_writer import ARCHIVE, BOTH, PUBLISH, KeyWriter
from due.keys import Key
from due.liveness import Liveness
from due.membership import APP_ID, MOST_SHARDS, Registration
from due.messages import (
    Assignment,
    AssignmentCallback,
    Capability,
    Frequency,
    Instances,
    Interest,
    Item,
    Role,
)
from due.observation import Observation
from due.session import Session
from due.shards import ShardState

_MODES = (BOTH, PUBLISH, ARCHIVE, 0, BOTH, PUBLISH, ARCHIVE, 0)
"""By flag bits: PUB_ONLY = 1, DB_ONLY = 2, NO_WAIT = 4."""
_NO_WAIT = 4
_FLUSH_SECONDS = 30.0
_LONGEST_EVERY = 3600.0
_LONGEST_SHARD = 255


class Engine:
    """One app's connection to the data of all others.  Thread-safe.

    >>> engine = Engine(Options(coordinated=False))            # doctest: +SKIP
    >>> engine.init("thermometer", PRODUCER)                   # doctest: +SKIP
    >>> engine.write("house.climate.thermometer.attic", 21.5)  # doctest: +SKIP
    True

    Args:
        options: all options of the engine; None takes the defaults.

    Raises:
        InvalidOption: an option is out of bounds.
        EngineFailed: from every method but `close`, after a thread of the engine has died.
    """

    def __init__(self, options: Options | None = None) -> None:
        self.options = (options or Options()).with_credential().checked()
        self._updates_url = default_updates(self.options)
        self._archive_url = default_archive(self.options)
        self._registration: Registration | None = None
        self._shards: tuple[str, ...] = ()
        self._session: Session | None = None
        self._broken: Session | None = None
        """The session after one of its threads died, until `close`."""
        self._writers: dict[str, KeyWriter] = {}
        self._lock = threading.RLock()
        self.when_failed: Callable[[], None] = lambda: None
        """Called by a thread that dies; `due.service` ends the process."""
        _engines.add(self)

    @property
    def app_id(self) -> str:
        """The app id given to `init`; empty before."""
        return self._registration.app_id if self._registration else ""

    @property
    def instance_id(self) -> str:
        """16 hexadecimal digits that identify this process; new with each `init`."""
        return self._registration.instance_id if self._registration else ""

    @property
    def failed(self) -> BaseException | None:
        """The error that killed a thread of the engine; None while all run."""
        return self._broken.failure if self._broken is not None else None

    @property
    def updates(self) -> str:
        """The URL of Data Updates, with the password in it; also of an embedded server that the engine has found.

        Raises:
            NotInitialised: called before `init` or after `close`.
        """
        return self._require().updates_url

    @property
    def liveness(self) -> Liveness:
        """Whether the engine's threads still make progress, for a supervisor."""
        return self._require().liveness

    def set_pubsub(self, url: str) -> None:
        """Choose the Data Updates server; call it before `init`.

        Args:
            url: redis://, rediss://, redis+sentinel://, unix://, kafka:// or memory://.

        Raises:
            InvalidOption: the engine is already initialised.
        """
        self._before_init("set_pubsub")
        self._updates_url = url

    def set_db(self, url: str) -> None:
        """Choose the Data Archives; call it before `init`.

        Args:
            url: sqlite:///path/file.db, mongodb://host/database or memory://.

        Raises:
            InvalidOption: the engine is already initialised.
        """
        self._before_init("set_db")
        self._archive_url = url

    def init(
        self,
        app_id: str,
        role: Role = Role.PRODUCER | Role.CONSUMER,
        *,
        interests: Iterable[Interest] = (),
        capabilities: Iterable[Capability] = (),
        instances: Instances = "standby",
        shards: Iterable[str] = (),
    ) -> None:
        """Connect to Data Updates and register with the Coordinator.

        Args:
            app_id: name of the app, A-Z a-z 0-9 _ - only.
            role: PRODUCER, CONSUMER, or both.
            interests: the keys this app wants; `observe` adds more.
            capabilities: the keys this app can write; other keys may be written as well.
            instances: "standby": one instance is active, the others are standbys; "shared": all of them are active and
                divide the items of reliable keys; "sharded": all of them are active, and each reliable path is read,
                in order, by one of them, as the Coordinator divides the paths.
            shards: names of what the instances of a sharded app divide instead of the reliable paths; see `shards`.
                Then every instance gets every item, and a new one those that are written from now on.

        Raises:
            InvalidKey: a key breaks the grammar.
            InvalidOption: the app id, `instances`, `shards` or a declaration is wrong, or `init` was called before.
            UpdatesUnavailable: Data Updates did not answer within `Options.connect_timeout`.
        """
        self._before_init("init")
        if not isinstance(app_id, str) or not re.fullmatch(APP_ID, app_id):
            raise InvalidOption(f"app id {app_id!r}: must be 1 to {MAX_ID} characters of A-Z a-z 0-9 _ -")
        if instances not in get_args(Instances):
            raise InvalidOption(f"instances={instances!r}: must be 'standby', 'shared' or 'sharded'")
        self._shards = _checked_shards(tuple(shards), instances)
        self._start(
            _checked_registration(
                app_id=app_id,
                instance_id=uuid4().hex[:16],
                instances=instances,
                revision=1,
                capabilities=tuple(capabilities),
                interests=tuple(interests),
                producer=Role.PRODUCER in role,
                consumer=Role.CONSUMER in role,
                heartbeat=self.options.heartbeat,
                started=time.time_ns(),
                host=socket.gethostname(),
                pid=os.getpid(),
            )
        )

    def write(
        self, key: str, value: Any, flags: Iterable[int] = (), *, event_time: int | None = None
    ) -> bool:
        """Publish and archive one value under a concrete key.

        It waits only under back-pressure, when the readers of a reliable stream are behind. A callback must
        therefore not fill a reliable stream that its own app reads. Mutable values and a RecordBatch are
        encoded before this returns.

        Args:
            key: a key without wildcards and lists.
            value: a plain value (None, bool, int, float, str, bytes, datetime), a list or map of them, a
                numpy array or a RecordBatch.
            flags: PUB_ONLY, DB_ONLY, NO_WAIT (send at once instead of waiting for a full frame).
            event_time: when the described event happened, ns since the epoch; None takes the time of writing.

        Returns:
            False if nobody wants the item or this instance is not the active one, or if that is not known and
            there is no room to hold the item. Of these, unwanted items are archived if the capability says
            `archive="always"`.

        Raises:
            InvalidKey: the key breaks the grammar or has wildcards.
            InvalidOption: the flags cannot be combined, or the event time is out of bounds.
            UnsupportedValue: the value is not of a DUE type.
            NotAllowed: `init` was not given the role PRODUCER.
            NotInitialised: called before `init` or after `close`.
            EngineFailed: a thread of the engine has died.
        """
        writer = self._writers.get(key) or self._writer(key)
        now = time.time_ns()
        bits = 0
        for flag in flags:
            bits |= flag
        mode = _MODES[bits]
        if not mode:
            raise InvalidOption(f"write({key!r}): PUB_ONLY and DB_ONLY cannot be combined")
        if event_time is not None:
            event_time = checked_time(event_time)
        session = self._session or self._require()
        if awake_ns() > session.heartbeats.alive_until:
            session.heartbeats.check_pause()
        with writer.lock:
            if writer.fast:
                if bits >= _NO_WAIT:
                    writer.put(value, mode, event_time, now, stays=False)
                    writer.cut()
                else:
                    writer.put(value, mode, event_time, now)
                return True
            if not writer.retired:
                return session.admission.write(
                    writer, (freeze(value), mode, bits >= _NO_WAIT, event_time, now)
                )
        self._writers.pop(key, None)
        return self.write(key, value, (bits,), event_time=event_time)

    def flush(self, timeout: float = _FLUSH_SECONDS) -> None:
        """Wait until everything written so far has reached the backends.

        For reliable keys this is the producer's acknowledgement.

        Args:
            timeout: seconds.

        Raises:
            Timeout: it took longer.
            Superseded: another instance took this one's place before all of it was acknowledged.
        """
        self._require().flush(timeout)

    @property
    def connected(self) -> bool:
        """Whether Data Updates have answered recently, so that items of other apps can arrive."""
        return self._require().connected

    @property
    def active(self) -> bool:
        """Whether this instance is known to be active.

        False while it is a standby, and until the Coordinator has said which instance is active; items written meanwhile may
        be refused. Right after the death of an instance the Coordinator still names the dead one.
        """
        return self._require().active

    def observe(
        self, key: str, *, frequency: Frequency = None, since: int | datetime | str | None = None
    ) -> Observation:
        """Receive the items under a key, through a ReactiveX Subject.

        Callbacks run one at a time in the dispatcher thread; a slow one holds back the producers of reliable
        keys. The position in a reliable stream is kept while the app is away, and dropped soon after the last
        subscription is disposed.

        Args:
            key: wildcards and lists are allowed.
            frequency: the wanted rate, Hz, or (minimum, maximum); None takes every item.
            since: replay a reliable key from this time (int ns, datetime) or stream id, as far as it is
                retained.

        Returns:
            The Subject; nothing is received before `subscribe`.

        Raises:
            InvalidKey: the key breaks the grammar.
            NotAllowed: `init` was not given the role CONSUMER.
            NotInitialised: called before `init` or after `close`.
        """
        session = self._require()
        if not session.heartbeats.member.registration.consumer:
            raise NotAllowed(f"observe({key!r}): init was not given the role CONSUMER")
        return Observation(Key.parse(key), frequency, _start_id(since), session.opened, session.closed)

    def get(self, query: str | Mapping[str, Any], *, limit: int | None = None) -> list[Item]:
        """Read items from Data Archives, after this engine's own archive writes have been flushed.

        Args:
            query: a key (wildcards allowed), or a query in MongoDB's dialect.
            limit: return at most this many, the newest; None returns all.

        Returns:
            Items, oldest first.

        Raises:
            InvalidKey: the key breaks the grammar.
            InvalidQuery: the query has an unknown operator or a wrong operand.
            ArchiveUnavailable: the archive cannot be reached.
            Timeout: own archive writes could not be flushed within 30 s.
        """
        session = self._require()
        if isinstance(query, str):
            query = {"dataKey": Key.parse(query).text}
        session.flush_archive(_FLUSH_SECONDS)
        return session.archive.find(query, limit=limit)

    def declare(
        self,
        *,
        interests: Iterable[Interest] | None = None,
        capabilities: Iterable[Capability] | None = None,
    ) -> None:
        """Replace what `init` declared to the Coordinator.

        Args:
            interests: the keys this app wants, beside those that it observes; None leaves them.
            capabilities: the keys this app can write; None leaves them.

        Raises:
            InvalidOption: there are too many.
            NotInitialised: called before `init` or after `close`.
        """
        self._require().declare(
            None if interests is None else tuple(interests),
            None if capabilities is None else tuple(capabilities),
        )

    def keep_state(self, state: ShardState, *, every: float = 5.0) -> None:
        """Keep the state of a sharded app by path, so that a path can move to another instance with its state.

        Items are then acknowledged when the state that contains them is saved. Call it before the first subscription.

        Args:
            state: loads and saves; called in the dispatcher thread.
            every: seconds between two times that a path's state is saved.

        Raises:
            InvalidOption: the app is not sharded, subscribes already, or `every` is not above zero.
            NotInitialised: called before `init` or after `close`.
        """
        if not 0 < every <= _LONGEST_EVERY:
            raise InvalidOption(f"every={every}: must be greater than 0 and at most {_LONGEST_EVERY:g} s")
        self._require().keep_state(state, every)

    def shards(self) -> frozenset[str] | None:
        """Which of the shards named in `init` are this instance's now.

        The Coordinator divides them evenly, and moves no more than necessary when an instance comes, ends or dies.
        Without a Coordinator one instance has all of them. An instance that was suspended may hear late that a
        shard has moved; where two must never work on it, something else has to keep them apart.

        Returns:
            The names; None while that is not known, for instance after a suspension: nothing has moved then.

        Raises:
            NotInitialised: called before `init` or after `close`.
        """
        return self._require().heartbeats.named_here()

    def offer_shards(self, names: Iterable[str]) -> None:
        """Say which of the shards named in `init` this instance can work on; without a call, all of them.

        Args:
            names: others are withdrawn from this instance, and given to those that can work on them.

        Raises:
            InvalidOption: a name was not given to `init`.
            NotInitialised: called before `init` or after `close`.
        """
        offered = tuple(names)
        session = self._require()
        if not set(offered) <= set(self._shards):
            raise InvalidOption(f"offer_shards({list(offered)!r}): init was given {list(self._shards)!r}")
        session.heartbeats.offer(offered)

    def on_assignments(self, callback: AssignmentCallback) -> None:
        """Call back whenever this app's assignments change, and once immediately.

        Args:
            callback: gets all current assignments; called in the dispatcher thread.
        """
        self._require().on_assignments(callback)

    def assignments(self) -> tuple[Assignment, ...]:
        """The current assignments of this app.

        Returns:
            One per capability and matching interest; empty while nobody wants anything.
        """
        return self._require().heartbeats.member.assignments

    def wanted(self, key: str) -> bool:
        """Ask whether anybody wants what a key names.

        Args:
            key: the key of an item, or of several.

        Returns:
            True also while no Coordinator can be asked.

        Raises:
            InvalidKey: the key breaks the grammar.
        """
        heartbeats = self._require().heartbeats
        with heartbeats.lock:
            return heartbeats.member.wanted(Key.parse(key))

    def set_aside(self) -> list[tuple[Item, str]]:
        """Items of reliable keys on which this app's callbacks kept failing.

        Returns:
            Pairs of item and cause, oldest first. Refused frames are included as far as they can be decoded.
        """
        return [
            (item, reason)
            for payload, reason in self._require().dispatcher.receiver.aside()
            for item in _readable(payload)
        ]

    def health(self) -> dict[str, Any]:
        """Counters and states of the engine.

        Returns:
            A map of plain values; the same figures are exported to Prometheus.
        """
        return self._require().health()

    def tend(self) -> None:
        """Let go of files that were replaced; `Service` calls it every second.

        An archive of SQLite whose file is moved or replaced keeps its space as long as a process has it open.  Every
        call that reads or writes the archive notices; a program without `Service` that may do neither for long
        calls this.
        """
        if (session := self._session) is not None:
            session.tend()

    def close(self) -> None:
        """Send what is still queued, sign off from the Coordinator and disconnect.  Safe to call twice."""
        session = self._session
        if session is not None and session.dispatcher.shards is not None:
            session.dispatcher.finish()  # what it saves is written by this engine
        with self._lock:
            session = self._session or self._broken
            self._session = self._broken = self._registration = None
            self._writers = {}
        if session is not None:
            session.close()

    def after_fork(self) -> None:
        """Drop the parent's connections in a forked child; the next call opens new ones.

        Observations and their callbacks stay with the parent.
        """
        _inherited.extend(session for session in (self._session, self._broken) if session is not None)
        self._session = self._broken = None
        self._writers = {}
        self._lock = threading.RLock()

    def _before_init(self, what: str) -> None:
        if self._session is not None or self._broken is not None:
            raise InvalidOption(f"{what} comes before init; close() first")

    def _start(self, registration: Registration) -> None:
        self._session = Session(
            self.options,
            registration,
            updates_url=self._updates_url,
            archive_url=self._archive_url,
            failed=self._fail,
            shards=self._shards,
        )
        self._registration = registration
        try:
            self._session.start()
        except BackendError:
            self._session = self._registration = None
            raise

    def _fail(self, error: BaseException) -> None:
        """A thread has died: hide the session from all calls.  No lock: a waiting thread may hold it."""
        if self._session is not None and self._session.failure is error:
            self._broken, self._session = self._session, None
            self._writers = {}
            self.when_failed()

    def _require(self) -> Session:
        session = self._session
        if session is None:
            if self._broken is not None:
                self._broken.check()
            with self._lock:
                old = self._registration
                if self._session is None and old is not None:  # forked
                    self._start(_reborn(old))
                session = self._session
        if session is None:
            raise NotInitialised("the engine is not initialised: call init(app_id, role) first")
        return session

    def _writer(self, text: str) -> KeyWriter:
        session = self._require()
        key = Key.parse(text)
        if not key.concrete:
            at = max(text.find("*"), 0)
            raise InvalidKey(text, at, "items are written under concrete keys, without wildcards and lists")
        if not session.heartbeats.member.registration.producer:
            raise NotAllowed(f"write({text!r}): init was not given the role PRODUCER")
        retirements = session.retirements
        writer = session.writer(key)
        if session.retirements != retirements:
            self._writers = {}
        self._writers[text] = writer
        return writer


def _checked_shards(shards: tuple[str, ...], instances: Instances) -> tuple[str, ...]:
    """Raises `InvalidOption`."""
    if shards and instances != "sharded":
        raise InvalidOption('shards are for apps with instances="sharded"')
    if len(set(shards)) != len(shards) or len(shards) > MOST_SHARDS:
        raise InvalidOption(f"shards: {len(shards)} names; give at most {MOST_SHARDS}, each once")
    if not all(isinstance(name, str) and 0 < len(name) <= _LONGEST_SHARD for name in shards):
        raise InvalidOption(f"shards: a name must have 1 to {_LONGEST_SHARD} characters")
    return shards


def _checked_registration(**fields: Any) -> Registration:
    registration = Registration(**fields)
    try:
        Registration.from_value(registration.to_value())
    except msgspec.ValidationError as error:  # it would be refused by the Coordinator
        raise InvalidOption(f"init: {error}") from None
    return registration


def _readable(payload: bytes) -> list[Item]:
    try:
        return unpack(payload)
    except DecodeError:
        return []


def _reborn(old: Registration) -> Registration:
    return msgspec.structs.replace(
        old, instance_id=uuid4().hex[:16], revision=1, started=time.time_ns(), pid=os.getpid()
    )


def _start_id(since: int | datetime | str | None) -> str:
    """A stream id from which to replay."""
    if since is None:
        return ""
    if isinstance(since, str):
        return since
    if isinstance(since, datetime):
        aware = since if since.tzinfo else since.replace(tzinfo=UTC)
        return f"{int(aware.timestamp() * 1000)}-0"
    return f"{since // 1_000_000}-0"


_engines: "weakref.WeakSet[Engine]" = weakref.WeakSet()
_inherited: list[Session] = []
"""Sessions of the parent of a fork: kept from the garbage collector, which would close their sockets."""


def _close_all() -> None:
    for engine in list(_engines):
        engine.close()


def _forget_all() -> None:
    for engine in list(_engines):
        engine.after_fork()


atexit.register(_close_all)
os.register_at_fork(after_in_child=_forget_all)
