"""The engine: what an app holds in its hand.

    write ──► Gate ──► Outlet (numbers, batches) ──► Publisher ──► Data Updates    sender thread: what lingers
               ▲                              └────► Archiver ───► Data Archives   archiver thread
               │ permission, pace
             Member ◄── Keeper (heartbeats, assignments)                           keeper thread

    observe ──► Observation ◄── Dispatcher ◄── Receiver ◄── Data Updates           dispatcher thread

`Engine` is the face; `Session` holds the parts between `init` and `close`.
"""

import atexit
import os
import socket
import threading
import time
import weakref
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import Any
from uuid import uuid4

from due.backends import default_archive, default_updates
from due.codec import freeze, unpack
from due.config import Options
from due.errors import BackendError, InvalidKey, InvalidOption, NotAllowed, NotInitialised
from due.keys import Key
from due.membership import Registration
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
from due.outlet import ARCHIVE, BOTH, PUBLISH, Outlet
from due.session import Session

_MODES = (BOTH, PUBLISH, ARCHIVE, 0, BOTH, PUBLISH, ARCHIVE, 0)
"""By flag bits: PUB_ONLY = 1, DB_ONLY = 2, NO_WAIT = 4."""
_NO_WAIT = 4
_FLUSH_SECONDS = 30.0


class Engine:
    """One app's connection to the data of all others.  Thread-safe.

    >>> engine = Engine(Options(coordinated=False))            # doctest: +SKIP
    >>> engine.init("thermometer", PRODUCER)                   # doctest: +SKIP
    >>> engine.write("house.climate.thermometer.attic", 21.5)  # doctest: +SKIP
    True
    """

    def __init__(self, options: Options | None = None) -> None:
        self.options = (options or Options()).checked()
        self._updates_url = default_updates(self.options)
        self._archive_url = default_archive(self.options)
        self._registration: Registration | None = None
        self._session: Session | None = None
        self._outlets: dict[str, Outlet] = {}
        self._lock = threading.RLock()
        _engines.add(self)

    @property
    def app_id(self) -> str:
        """As given to `init`; empty before."""
        return self._registration.app_id if self._registration else ""

    @property
    def instance_id(self) -> str:
        """Of this engine; new with each `init`."""
        return self._registration.instance_id if self._registration else ""

    def set_pubsub(self, url: str) -> None:
        """Which Data Updates server to use: redis://, rediss:// or unix://; before `init`."""
        self._before_init("set_pubsub")
        self._updates_url = url

    def set_db(self, url: str) -> None:
        """Which Data Archives to use: sqlite:///path/file.db or mongodb://host/database; before `init`."""
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
    ) -> None:
        """Connect and register.  Raises `InvalidKey`, `InvalidOption`, `UpdatesUnavailable`."""
        self._before_init("init")
        if Key(app_id).segments != (app_id,) or "*" in app_id:
            raise InvalidOption(f"app id {app_id!r}: one segment of A-Z a-z 0-9 _ -")
        if instances not in ("standby", "shared"):
            raise InvalidOption(f"instances {instances!r}: 'standby' or 'shared'")
        self._start(
            Registration(
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

        `flags`: PUB_ONLY, DB_ONLY, NO_WAIT (send at once).  `event_time`: ns.  Returns False if nobody
        wants it (then it is archived only under `archive="always"`) or this instance is not the active
        one.  Waits only for back-pressure: a reliable stream whose readers are behind (so a callback must
        not fill a reliable stream that its own app reads).  A RecordBatch is encoded at once, other
        mutable values too.  Raises `InvalidKey`, `UnsupportedValue`, `NotAllowed`.
        """
        outlet = self._outlets.get(key) or self._outlet(key)
        now = time.time_ns()
        bits = 0
        for flag in flags:
            bits |= flag
        mode = _MODES[bits]
        if not mode:
            raise InvalidOption(f"write({key!r}): PUB_ONLY and DB_ONLY exclude each other")
        session = self._session or self._require()
        if now > session.keeper.alive_until:
            session.keeper.check_pause()
        with outlet.lock:
            if outlet.fast:
                if bits >= _NO_WAIT:
                    outlet.put(value, mode, event_time, now, stays=False)
                    outlet.cut()
                else:
                    outlet.put(value, mode, event_time, now)
                return True
            if not outlet.retired:
                return session.gate.write(outlet, (freeze(value), mode, bits >= _NO_WAIT, event_time, now))
        self._outlets.pop(key, None)
        return self.write(key, value, (bits,), event_time=event_time)

    def flush(self, timeout: float = _FLUSH_SECONDS) -> None:
        """Return when all written so far is in the backends; raises `Timeout` (seconds).

        For reliable keys this is the producer's acknowledgement.
        """
        self._require().flush(timeout)

    def observe(
        self, key: str, *, frequency: Frequency = None, since: int | datetime | str | None = None
    ) -> Observation:
        """A ReactiveX Subject of the items under `key` (wildcards allowed); subscribe to receive.

        Callbacks run one at a time in the dispatcher thread; a slow one holds back the producers of
        reliable keys.  The place in a reliable key is kept while the app is away; it is given up soon
        after its last subscription is disposed.  `since` replays reliable keys from a time (int ns, datetime) or a stream id, as
        far as they are kept.  Raises `InvalidKey`, `NotAllowed`.
        """
        session = self._require()
        if not session.keeper.member.registration.consumer:
            raise NotAllowed(f"observe({key!r}): init was not given the role CONSUMER")
        return Observation(Key.parse(key), frequency, _start_id(since), session.opened, session.closed)

    def get(self, query: str | Mapping[str, Any], *, limit: int | None = None) -> list[Item]:
        """Items from Data Archives, oldest first: of a key (wildcards allowed) or a MongoDB-dialect query.

        Of more than `limit` the youngest.

        Flushes this engine's own archive writes first.  Raises `InvalidKey`, `InvalidQuery`,
        `ArchiveUnavailable`.
        """
        session = self._require()
        if isinstance(query, str):
            query = {"dataKey": Key.parse(query).text}
        session.flush_archive(_FLUSH_SECONDS)
        return session.archive.find(query, limit=limit)

    def on_assignments(self, callback: AssignmentCallback) -> None:
        """Call back, in the dispatcher thread, when what is wanted of this app changes, and once now."""
        self._require().on_assignments(callback)

    def assignments(self) -> tuple[Assignment, ...]:
        """What is wanted of this app now."""
        return self._require().keeper.member.assignments

    def wanted(self, key: str) -> bool:
        """Whether somebody wants what `key` names; True while no Coordinator is there to ask."""
        keeper = self._require().keeper
        with keeper.lock:
            return keeper.member.wanted(Key.parse(key))

    def set_aside(self) -> list[tuple[Item, str]]:
        """Items of reliable keys that this app's callbacks kept failing on, and why, oldest first."""
        return [
            (item, reason)
            for payload, reason in self._require().dispatcher.receiver.aside()
            for item in unpack(payload)
        ]

    def health(self) -> dict[str, Any]:
        """Counters and states, for people and metrics."""
        return self._require().health()

    def close(self) -> None:
        """Send what waits, say goodbye to the Coordinator, disconnect.  Safe to call twice."""
        with self._lock:
            session, self._session, self._registration = self._session, None, None
            self._outlets = {}
        if session is not None:
            session.close()

    def after_fork(self) -> None:
        """In a forked child: leave the parent's connections alone; the next call makes our own.

        Observations and their callbacks stay with the parent.
        """
        if self._session is not None:
            _inherited.append(self._session)
        self._session = None
        self._outlets = {}
        self._lock = threading.RLock()

    def _before_init(self, what: str) -> None:
        if self._session is not None:
            raise InvalidOption(f"{what} comes before init; close() first")

    def _start(self, registration: Registration) -> None:
        self._session = Session(
            self.options, registration, updates_url=self._updates_url, archive_url=self._archive_url
        )
        self._registration = registration
        try:
            self._session.start()
        except BackendError:
            self._session = self._registration = None
            raise

    def _require(self) -> Session:
        session = self._session
        if session is None:
            with self._lock:
                old = self._registration
                if self._session is None and old is not None:  # forked
                    self._start(_reborn(old))
                session = self._session
        if session is None:
            raise NotInitialised("the engine is not initialised: call init(app_id, role) first")
        return session

    def _outlet(self, text: str) -> Outlet:
        session = self._require()
        key = Key.parse(text)
        if not key.concrete:
            at = max(text.find("*"), 0)
            raise InvalidKey(text, at, "items are written under concrete keys, without wildcards and lists")
        if not session.keeper.member.registration.producer:
            raise NotAllowed(f"write({text!r}): init was not given the role PRODUCER")
        retirements = session.retirements
        outlet = session.outlet(key)
        if session.retirements != retirements:
            self._outlets = {}
        self._outlets[text] = outlet
        return outlet


def _reborn(old: Registration) -> Registration:
    return Registration(
        app_id=old.app_id,
        instance_id=uuid4().hex[:16],
        instances=old.instances,
        revision=1,
        capabilities=old.capabilities,
        interests=old.interests,
        producer=old.producer,
        consumer=old.consumer,
        heartbeat=old.heartbeat,
        started=time.time_ns(),
        host=old.host,
        pid=os.getpid(),
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
