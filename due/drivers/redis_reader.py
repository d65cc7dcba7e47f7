"""Reading reliable streams as a member of a group: XREADGROUP, XACK, and the pending work of the dead.

One request is outstanding at a time; acknowledgements travel with the next request.  Order: before
reading what is new, a path's pending entries come first: our own after a reconnect, and those of
members that died.  While another member that still lives has pending entries, a standby member holds.
A member is dead when this one has watched its lease unchanged for 3 s (see `redis_leases`).
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import hiredis
import redis

from due.backoff import Backoff
from due.drivers.base import Delivery
from due.drivers.redis_aside import Aside
from due.drivers.redis_leases import LEFT, LeaseValue, LeaseWatch, lease_name
from due.drivers.redis_streams import PRODUCERS, announced_name, stream_name
from due.drivers.redis_upkeep import Upkeep
from due.drivers.redis_wire import Wire, pack, understood
from due.errors import UpdatesUnavailable
from due.logs import without_passwords

log = logging.getLogger("due.updates")

_COUNT = 16
_BLOCK_MS = 1000
_SILENT_SECONDS = 3.0
"""A member whose lease has not changed for this long counts as dead."""
_LOOK_SECONDS = 1.0
"""Seconds between two checks of the other members; a single member checks less often."""
_HOLD_SECONDS = 0.2
_MOST_PRODUCERS = 4096
"""Most apps whose announcements are read, because any program may name one."""
_MOST_PATHS = 4096
"""Most streams that one member reads, because any program may announce paths."""
_TRIES = 3
"""Immediate attempts to create a group, in case the connection was just lost."""
_SKIP_REPLY = pack((b"CLIENT", b"REPLY", b"SKIP"))


class StreamReader:
    """A member of a group of readers.  `read`, `acknowledge` and `care` belong to one thread."""

    def __init__(self, url: str, commands: Any, group: str, consumer: str, *, shared: bool) -> None:
        self._url, self._place = url, without_passwords(url)
        self._commands = commands  # Any: redis-py types an answer by options it cannot see
        self._group = group
        self._consumer = consumer
        self._shared = shared
        self._lock = threading.Lock()
        self._leases = threading.Lock()
        """Held while leases are written; otherwise one could be renewed after it was given up."""
        self._paths: dict[str, str] = {}
        self._wire: Wire | None = None
        self._wire_id = 0
        self._expected: deque[str] = deque()
        self._acks: deque[tuple[str, str]] = deque()
        self._acks_sent: deque[tuple[str, str]] = deque()
        self._catch_up: set[str] = set()
        self._requested: tuple[str, ...] = ()
        self._held: set[str] = set()
        self._unmade: dict[str, tuple[str, bool, float]] = {}
        """Groups that could not be created: start, and since when; their streams are not read before that."""
        self._lease = LeaseValue()
        self._watches: dict[str, LeaseWatch] = {}
        self._upkeep = Upkeep(commands, group, consumer)
        self._aside = Aside(commands, group)
        self._server_time = ServerTime(commands)
        self._look_at = 0.0
        self._alone = False
        self._quiet = False
        """Whether the server can suppress the reply to an XACK."""
        self._claimed: deque[Delivery] = deque()
        self._backoff = Backoff()
        self._active = True
        self._take_over = False
        self._stale = False
        self._connected_before = False
        self._denied: set[str] = set()
        """Paths without a right to read them."""
        self._counts = {"claimed": 0, "paths_refused": 0, "paths_denied": 0}

    def known(self) -> list[str]:
        """Paths of all streams that producers announced."""
        try:
            apps = sorted(self._commands.smembers(PRODUCERS))[:_MOST_PRODUCERS]
            pipe = self._commands.pipeline(transaction=False)
            for app in apps:
                pipe.zrange(announced_name(app.decode("ascii", "replace")), 0, -1)
            found = pipe.execute(raise_on_error=False)
            paths = {path for one in found if isinstance(one, list) for path in one}
            return sorted(path.decode("ascii", "replace") for path in paths)
        except (redis.RedisError, OSError) as error:
            raise UpdatesUnavailable(str(error)) from None

    def add(self, path: str, start: str, *, reset: bool = False) -> None:
        """Read this stream too; `start` counts if the group is new to it, or `reset`."""
        with self._lock:
            if path in self._denied or (path in self._paths and not reset):
                return
            if len(self._paths) >= _MOST_PATHS and path not in self._paths:
                self._refuse(path)
                return
            self._paths[path] = start
            self._upkeep.added(path)
            self._held.add(path)
            self._look_at = 0.0
            self._stale = True
        self._create_group(path, start, reset=reset)
        self.renew()
        self._interrupt()

    def leave(self, stays: Callable[[str], bool]) -> None:
        """Stop reading paths without an observation."""
        with self._lock:
            gone = [path for path in self._paths if not stays(path)]
            for path in gone:
                del self._paths[path]
                self._held.discard(path)
                self._unmade.pop(path, None)
                self._watches.pop(path, None)
            self._stale = bool(gone)
            self._upkeep.withdrawn(gone, time.monotonic())
        with self._leases:
            self._write_leases(gone, LEFT)
        self._interrupt()

    def activate(self, active: bool, *, take_over: bool) -> None:
        """Read, or rest as a standby."""
        with self._lock:
            if active and not self._active:
                self._held.update(self._paths)
                self._look_at = 0.0
            self._active = active
            self._take_over = take_over
            self._stale = True
        self._interrupt()

    def fileno(self) -> int:
        """For select; -1 while there is nothing to wait for."""
        return self._wire.fileno() if self._wire is not None else -1

    def patience(self) -> float:
        """How long `receive` may wait at most, seconds."""
        if self._claimed:
            return 0.0
        if not self._paths or not self._active:
            return 60.0
        return 0.05 if self._wire is None else _HOLD_SECONDS if self._held else _LOOK_SECONDS

    def care(self) -> None:
        """Take over from dead members, reconnect, and request more; called before each wait."""
        if not self._paths or not self._active:
            self._flush_acks()
            return
        now = time.monotonic()
        if now >= self._look_at:
            usual = _SILENT_SECONDS if self._alone else _LOOK_SECONDS
            self._look_at = now + (_HOLD_SECONDS if self._held else usual)
            self._look_after_the_dead()
        try:
            if self._wire is None and self._backoff.due(now):
                self._connect()
            if self._wire is not None and not self._expected:
                self._request(self._wire)
        except UpdatesUnavailable as error:
            self._lose(error)

    def read(self, ready: set[int]) -> list[Delivery]:
        """Received entries, claimed ones first."""
        deliveries = list(self._claimed)
        self._claimed.clear()
        if self._wire is None or self._wire.fileno() not in ready:
            return deliveries
        try:
            for reply in self._wire.replies():
                deliveries += self._reply(reply)
            if not self._expected and not deliveries:
                self.care()
        except UpdatesUnavailable as error:
            self._lose(error)
        return deliveries

    def acknowledge(self, delivery: Delivery) -> None:
        """Remember to acknowledge; sent with the next request."""
        self._acks.append((delivery.path, delivery.token))

    def set_aside(self, path: str, payload: bytes, reason: str) -> None:
        """Set a payload aside."""
        self._aside.put(path, payload, reason)

    def aside(self) -> list[tuple[bytes, str]]:
        """What was set aside for the group, with reasons; raises `UpdatesUnavailable`."""
        return self._aside.all()

    def renew(self) -> None:
        """Renew the leases; a standby instance keeps the group's position, too."""
        with self._leases:
            self._write_leases(list(self._paths), self._lease.next())
        self._upkeep.tick(list(self._paths), time.monotonic())

    def statistics(self) -> dict[str, int]:
        """Counters for `health`."""
        sizes = {"held_paths": len(self._held), "read_paths": len(self._paths)}
        return {**self._counts, **sizes, **self._aside.counts, **self._upkeep.counts}

    def close(self) -> None:
        """Acknowledge what is done, give up the leases for good, close."""
        self._flush_acks()
        with self._lock:
            paths, self._paths = list(self._paths), {}
        with self._leases:
            self._write_leases(paths, LEFT)
        if self._wire is not None:
            self._wire.close()
            self._wire = None

    def _refuse(self, path: str) -> None:
        self._counts["paths_refused"] += 1
        if self._counts["paths_refused"] == 1:
            log.error(
                "%s reads at most %d reliable paths: %s and others are left out; observe a narrower key",
                self._group,
                _MOST_PATHS,
                path,
            )

    def _deny(self, path: str, error: Exception) -> None:
        """A right is missing: this path is left out, and the others are read on."""
        with self._lock:
            self._paths.pop(path, None)
            self._held.discard(path)
            if len(self._denied) < _MOST_PATHS:
                self._denied.add(path)
        self._counts["paths_denied"] += 1
        log.error(
            "%s has no right to read %s: %s; grant its key in [grants.%s]",
            self._group,
            path,
            error,
            self._group,
        )

    def _write_leases(self, paths: list[str], value: bytes) -> None:
        if not paths:
            return
        try:
            pipe = self._commands.pipeline(transaction=False)
            for path in paths:
                pipe.hset(lease_name(self._group, path), self._consumer, value)
            pipe.execute()
        except (redis.RedisError, OSError) as error:
            log.debug("leases could not be written: %s", error)

    def _create_group(
        self, path: str, start: str, *, reset: bool = False, since: float | None = None
    ) -> None:
        """`since`: when a group was first requested that could not be created then (s, monotonic)."""
        for _ in range(_TRIES):
            try:
                begin = self._server_time.start(since) if start == "$" and since is not None else start
                self._make_group(path, begin, reset=reset)
            except (redis.ConnectionError, redis.TimeoutError, OSError) as error:
                failed = error
                continue
            except redis.exceptions.NoPermissionError as error:
                self._deny(path, error)
            self._unmade.pop(path, None)
            return
        log.warning("group %s of %s cannot be created now: %s", self._group, path, failed)
        # entries from now on are wanted, even if the group is created later
        self._unmade[path] = (start, reset, time.monotonic() if since is None else since)

    def _make_group(self, path: str, start: str, *, reset: bool) -> None:
        try:
            self._commands.xgroup_create(stream_name(path), self._group, start, mkstream=True)
        except redis.ResponseError as error:
            if "BUSYGROUP" not in str(error):
                raise
            if reset:
                self._commands.xgroup_setid(stream_name(path), self._group, start)

    def _interrupt(self) -> None:
        """Make the server answer the blocked request now, so that a new one goes out."""
        if self._wire is not None and self._expected:
            try:
                self._commands.client_unblock(self._wire_id)
            except (redis.RedisError, OSError) as error:
                log.debug("the reader could not be interrupted: %s", error)

    def _connect(self) -> None:
        wire = Wire(self._url)
        with understood("CLIENT ID and TIME"):
            self._wire_id = int(wire.call("CLIENT", "ID"))
            self._server_time.note(_seconds(wire.call("TIME")))
        self._quiet = wire.call("CLIENT", "REPLY", "ON") == b"OK"
        self._backoff.succeeded()
        self._wire = wire
        self._expected.clear()
        self._acks.extendleft(reversed(self._acks_sent))
        self._acks_sent.clear()
        with self._lock:
            self._catch_up = set(self._paths) if self._connected_before else set()
        self._connected_before = True

    def _lose(self, error: Exception) -> None:
        if self._wire is not None:
            self._wire.close()
            self._wire = None
        delay = self._backoff.failed(time.monotonic())
        log.warning("streams at %s: %s; retrying in %.2f s", self._place, error, delay)

    def _request(self, wire: Wire) -> None:
        with self._lock:
            self._stale = False
            self._catch_up &= self._paths.keys()
            history = tuple(self._catch_up)
            paths = history or tuple(p for p in self._paths if p not in self._held)
            if not self._active:  # became a standby a moment ago
                history = paths = ()
        command = self._packed_acks(quietly=self._quiet and bool(paths))
        if paths:
            self._requested = paths
            wait = () if history or self._stale else (b"BLOCK", _BLOCK_MS)
            head = (b"XREADGROUP", b"GROUP", self._group, self._consumer, b"COUNT", _COUNT, *wait, b"STREAMS")
            command += pack((*head, *map(stream_name, paths), *((b"0" if history else b">",) * len(paths))))
            self._expected.append("read")
        if command:
            wire.send_packed(command)

    def _packed_acks(self, *, quietly: bool = False) -> bytes:
        """`quietly`: a read follows, so replies of their own would only cause wake-ups."""
        command = b""
        while self._acks:
            path = self._acks[0][0]
            tokens = []
            while self._acks and self._acks[0][0] == path:
                self._acks_sent.append(self._acks[0])
                tokens.append(self._acks.popleft()[1])
            if quietly:
                command += _SKIP_REPLY
            else:
                self._expected.append("ack")
            command += pack((b"XACK", stream_name(path), self._group, *tokens))
        return command

    def _flush_acks(self) -> None:
        if self._wire is None or not self._acks:
            return
        try:
            self._wire.send_packed(self._packed_acks())
        except UpdatesUnavailable as error:
            self._lose(error)

    def _reply(self, reply: Any) -> list[Delivery]:
        kind = self._expected.popleft() if self._expected else "read"
        if isinstance(reply, hiredis.ReplyError):
            self._repair(reply)
            return []
        if "ack" not in self._expected:
            self._acks_sent.clear()
        if kind == "ack":
            return []
        with understood("a request for entries"):
            found = [
                Delivery(name.decode()[len("due:stream:") :], fields[1], token.decode())
                for name, entries in reply or ()
                for token, fields in entries
                if fields
            ]
        if self._catch_up:
            self._catch_up &= {delivery.path for delivery in found}
        return found

    def _repair(self, error: Exception) -> None:
        """A group or stream is gone because the server restarted empty: begin at its beginning."""
        if "NOGROUP" in str(error) or "UNBLOCKED" in str(error):
            with self._lock:
                paths = list(self._paths)
            for path in paths:
                self._create_group(path, "0")
            self.renew()
            self._catch_up.clear()
            return
        if str(error).startswith("NOPERM"):
            self._drop_denied()
            return
        raise UpdatesUnavailable(f"reading streams was refused: {error}")

    def _drop_denied(self) -> None:
        """Rights were taken away from one of the paths of a request: find it."""
        for path in self._requested:
            try:
                self._commands.xinfo_consumers(stream_name(path), self._group)
            except redis.exceptions.NoPermissionError as error:
                self._deny(path, error)
            except (redis.RedisError, OSError) as error:
                log.debug("%s: %s", path, error)

    def _look_after_the_dead(self) -> None:
        with self._lock:
            paths = list(self._paths)
        self._alone = True
        for path in paths:
            unmade = self._unmade.get(path)
            if unmade is not None:
                self._create_group(path, unmade[0], reset=unmade[1], since=unmade[2])
            try:
                waits = self._claim(path)
            except (redis.RedisError, OSError) as error:
                log.debug("members of %s could not be checked: %s", path, error)
                self._alone = False
                continue
            if not waits or self._shared:
                with self._lock:
                    self._held.discard(path)
        self._take_over = False

    def _claim(self, path: str) -> bool:
        """Take the pending entries of dead members; returns whether a live one has some."""
        consumers: list[dict[str, Any]] = self._commands.xinfo_consumers(stream_name(path), self._group)
        others = [c for c in consumers if c["name"] != self._consumer.encode()]
        self._alone = self._alone and not others
        others = [c for c in others if c["pending"]]
        if not others:
            return False
        names = [c["name"] for c in others]
        watch = self._watches.setdefault(path, LeaseWatch(_SILENT_SECONDS))
        asked = time.monotonic()
        leases = self._commands.hgetall(lease_name(self._group, path))
        # a missing lease is treated like an unchanged one
        watch.look({name: leases.get(name, b"") for name in names}, asked, time.monotonic())
        waits = False
        for name in names:
            if not self._take_over and watch.silent(name) < _SILENT_SECONDS:
                waits = True
            else:
                self._claim_from(path, name)
        return waits

    def _claim_from(self, path: str, consumer: bytes) -> None:
        name = stream_name(path)
        low = "-"
        while True:
            pending: list[dict[str, Any]] = self._commands.xpending_range(
                name, self._group, low, "+", 1000, consumername=consumer
            )
            if not pending:
                return
            tries = {p["message_id"]: p["times_delivered"] + 1 for p in pending}
            claimed: list[tuple[bytes, dict[bytes, bytes] | None]] = self._commands.xclaim(
                name, self._group, self._consumer, 0, list(tries)
            )
            for token, fields in claimed:
                if fields:
                    self._counts["claimed"] += 1
                    payload = fields.get(b"f", b"")  # the decoder refuses entries of other programs
                    self._claimed.append(Delivery(path, payload, token.decode(), tries.get(token, 2)))
            low = "(" + pending[-1]["message_id"].decode()


class ServerTime:
    """Position of a stream at a time when the server could not be asked, by the server's own clock.

    Both ways to compute it agree unless that clock jumped; the earlier result is used, so that a jump causes
    repeated entries and never missing ones.
    """

    def __init__(self, commands: Any) -> None:
        self._commands = commands
        self._offset: float | None = None

    def note(self, seconds: float) -> None:
        """The server's clock now, s."""
        self._offset = seconds - time.monotonic()

    def start(self, since: float) -> str:
        """The id behind which everything was appended after `since` (s, monotonic)."""
        seconds, microseconds = self._commands.time()
        at = seconds + microseconds / 1e6 - (time.monotonic() - since)
        if self._offset is not None:
            at = min(at, self._offset + since)
        return str(max(0, int(at * 1000) - 1))


def _seconds(reply: Any) -> float:
    return int(reply[0]) + int(reply[1]) / 1e6
