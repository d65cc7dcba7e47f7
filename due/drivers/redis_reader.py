"""Reading reliable streams as a member of a group: XREADGROUP, XACK, and the pending work of the dead.

One request is outstanding at a time; acknowledgements travel with the next request.  Order: before
reading what is new, a path's pending entries come first: our own after a reconnect, and those of
members that died.  While another member that still lives has pending entries, a standby member holds.
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
from due.drivers.redis_streams import STREAMS, readers_name, stream_name
from due.drivers.redis_wire import Wire, pack
from due.errors import UpdatesUnavailable

log = logging.getLogger("due.updates")

_COUNT = 16
_BLOCK_MS = 1000
_SILENT_SECONDS = 3.0
"""A member whose lease is older is taken for dead."""
_LOOK_SECONDS = 1.0
"""How often to look after the other members; alone in a group, as often as one could be taken for dead."""
_HOLD_SECONDS = 0.2
_GONE_SECONDS = 30.0
"""Whoever has not renewed his lease for so long holds no group."""
_WITHDRAWN_SECONDS = 10.0
_FORGET_SECONDS = 3600.0
_ASIDE_LENGTH = 1000
_TRIES = 3
"""How often to try at once to make a group: a connection may just have been cut."""
_SKIP_REPLY = pack((b"CLIENT", b"REPLY", b"SKIP"))


def aside_name(group: str) -> str:
    """The stream of payloads set aside for a group."""
    return f"due:poison:{group}"


class StreamReader:
    """A member of a group of readers.  `read`, `acknowledge` and `care` belong to one thread."""

    def __init__(self, url: str, commands: Any, group: str, consumer: str, *, shared: bool) -> None:
        self._url = url
        self._commands = commands  # Any: redis-py types an answer by options it cannot see
        self._group = group
        self._consumer = consumer
        self._shared = shared
        self._lock = threading.Lock()
        self._leases = threading.Lock()
        """Held while leases are written, or one could be renewed after it was given up."""
        self._paths: dict[str, str] = {}
        self._wire: Wire | None = None
        self._wire_id = 0
        self._expected: deque[str] = deque()
        self._acks: deque[tuple[str, str]] = deque()
        self._acks_sent: deque[tuple[str, str]] = deque()
        self._catch_up: set[str] = set()
        self._requested: tuple[str, ...] = ()
        self._held: set[str] = set()
        self._withdrawn: dict[str, float] = {}
        self._unmade: dict[str, tuple[str, bool]] = {}
        """Groups that could not be made, with where they begin: such a stream stays held until it has one."""
        self._look_at = 0.0
        self._alone = False
        self._quiet = False
        """Whether the server can keep the reply to an XACK for itself."""
        self._claimed: deque[Delivery] = deque()
        self._backoff = Backoff()
        self._active = True
        self._take_over = False
        self._stale = False
        self._connected_before = False
        self._counts = {"claimed": 0, "set_aside": 0}

    def known(self) -> list[str]:
        """Paths of all streams that producers announced."""
        try:
            return sorted(path.decode() for path in self._commands.smembers(STREAMS))
        except (redis.RedisError, OSError) as error:
            raise UpdatesUnavailable(str(error)) from None

    def add(self, path: str, start: str, *, reset: bool = False) -> None:
        """Read this stream too; `start` counts if the group is new to it, or `reset`."""
        with self._lock:
            if path in self._paths and not reset:
                return
            self._paths[path] = start
            self._withdrawn.pop(path, None)
            self._held.add(path)
            self._look_at = 0.0
            self._stale = True
        self._create_group(path, start, reset=reset)
        self.renew()
        self._tidy(path)
        self._interrupt()

    def leave(self, stays: Callable[[str], bool]) -> None:
        """Stop reading the paths that nobody here wants any more."""
        with self._lock:
            gone = [path for path in self._paths if not stays(path)]
            for path in gone:
                del self._paths[path]
                self._held.discard(path)
                self._unmade.pop(path, None)
            self._stale = bool(gone)
            self._withdrawn.update(dict.fromkeys(gone, time.monotonic()))
        with self._leases:
            self._write_leases(gone, 0)
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
        """Look after the dead, connect, and ask for more; before each wait."""
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
        """What has arrived, claimed work first."""
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
        """Move a payload out of the way, visibly."""
        self._counts["set_aside"] += 1
        try:
            fields: dict[Any, Any] = {"path": path, "f": payload, "reason": reason}
            self._commands.xadd(aside_name(self._group), fields, maxlen=_ASIDE_LENGTH, approximate=True)
        except (redis.RedisError, OSError) as error:
            log.error("an item of %s could not be set aside: %s", path, error)  # noqa: TRY400 - no trace

    def aside(self) -> list[tuple[bytes, str]]:
        """What was set aside for the group, with reasons; raises `UpdatesUnavailable`."""
        try:
            entries = self._commands.xrange(aside_name(self._group))
        except (redis.RedisError, OSError) as error:
            raise UpdatesUnavailable(f"what was set aside cannot be listed: {error}") from None
        return [(fields[b"f"], fields[b"reason"].decode("utf-8", "replace")) for _, fields in entries]

    def renew(self) -> None:
        """Renew the leases; a standby instance holds the group's place too."""
        with self._leases:
            self._write_leases(list(self._paths), int(time.time() * 1000))
        self._drop_groups()

    def statistics(self) -> dict[str, int]:
        """Counters for `health`."""
        return {**self._counts, "held_paths": len(self._held)}

    def close(self) -> None:
        """Acknowledge what is done, give up the leases for good, close."""
        self._flush_acks()
        with self._lock:
            paths, self._paths = list(self._paths), {}
        with self._leases:
            self._write_leases(paths, 0)
        if self._wire is not None:
            self._wire.close()
            self._wire = None

    def _write_leases(self, paths: list[str], stamp: int) -> None:
        if not paths:
            return
        try:
            pipe = self._commands.pipeline(transaction=False)
            for path in paths:
                pipe.hset(readers_name(path), f"{self._group}/{self._consumer}", str(stamp))
            pipe.execute()
        except (redis.RedisError, OSError) as error:
            log.debug("leases could not be written: %s", error)

    def _create_group(self, path: str, start: str, *, reset: bool = False) -> None:
        for _ in range(_TRIES):
            try:
                self._make_group(path, start, reset=reset)
            except (redis.ConnectionError, redis.TimeoutError, OSError) as error:
                failed = error
                continue
            self._unmade.pop(path, None)
            return
        log.warning("group %s of %s cannot be made now: %s", self._group, path, failed)
        # what comes from now on is wanted, whenever the group can be made; it begins behind the id it is given
        self._unmade[path] = (str(int(time.time() * 1000) - 1) if start == "$" else start, reset)

    def _make_group(self, path: str, start: str, *, reset: bool) -> None:
        try:
            self._commands.xgroup_create(stream_name(path), self._group, start, mkstream=True)
        except redis.ResponseError as error:
            if "BUSYGROUP" not in str(error):
                raise
            if reset:
                self._commands.xgroup_setid(stream_name(path), self._group, start)

    def _drop_groups(self) -> None:
        """Of interests withdrawn a while ago: an app that withdraws them because it ends keeps its place."""
        with self._lock:
            due = [path for path, at in self._withdrawn.items() if time.monotonic() - at > _WITHDRAWN_SECONDS]
            for path in due:
                del self._withdrawn[path]
        for path in due:
            self._drop_group(path)

    def _drop_group(self, path: str) -> None:
        """Without another live member the group goes, and its place with it."""
        try:
            leases = self._commands.hgetall(readers_name(path))
            stamps = [int(at) / 1000 for field, at in leases.items() if self._is_ours(field)]
            if all(time.time() - at > _GONE_SECONDS for at in stamps):
                self._commands.xgroup_destroy(stream_name(path), self._group)
        except (redis.RedisError, OSError) as error:
            log.debug("group %s of %s could not be dropped: %s", self._group, path, error)

    def _tidy(self, path: str) -> None:
        """Forget leases of members long gone."""
        try:
            leases = self._commands.hgetall(readers_name(path))
            limit = 1000 * (time.time() - _FORGET_SECONDS)
            old = [field for field, at in leases.items() if self._is_ours(field) and int(at) < limit]
            if old:
                self._commands.hdel(readers_name(path), *old)
        except (redis.RedisError, OSError) as error:
            log.debug("leases of %s could not be tidied: %s", path, error)

    def _is_ours(self, field: bytes) -> bool:
        return field.rpartition(b"/")[0] == self._group.encode()

    def _interrupt(self) -> None:
        """Make the server answer the blocked request now, so that a new one goes out."""
        if self._wire is not None and self._expected:
            try:
                self._commands.client_unblock(self._wire_id)
            except (redis.RedisError, OSError) as error:
                log.debug("the reader could not be interrupted: %s", error)

    def _connect(self) -> None:
        wire = Wire(self._url)
        self._wire_id = int(wire.call("CLIENT", "ID"))
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
        log.warning("streams at %s: %s; trying again in %.2f s", self._url, error, delay)

    def _request(self, wire: Wire) -> None:
        with self._lock:
            self._stale = False
            self._catch_up &= self._paths.keys()
            history = tuple(self._catch_up)
            paths = history or tuple(p for p in self._paths if p not in self._held)
            if not self._active:  # put on standby a moment ago
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
        """`quietly`: a read follows, whose reply stands for theirs; each would wake us up before it."""
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
        """A group or stream is gone, because the server came back empty: begin at its beginning."""
        if "NOGROUP" in str(error) or "UNBLOCKED" in str(error):
            with self._lock:
                paths = list(self._paths)
            for path in paths:
                self._create_group(path, "0")
            self.renew()
            self._catch_up.clear()
            return
        raise UpdatesUnavailable(f"reading streams was refused: {error}")

    def _look_after_the_dead(self) -> None:
        with self._lock:
            paths = list(self._paths)
        self._alone = True
        for path in paths:
            unmade = self._unmade.get(path)
            if unmade is not None:
                self._create_group(path, unmade[0], reset=unmade[1])
            try:
                waits = self._claim(path)
            except (redis.RedisError, OSError) as error:
                log.debug("members of %s could not be looked after: %s", path, error)
                self._alone = False
                continue
            if not waits or self._shared:
                with self._lock:
                    self._held.discard(path)
        self._take_over = False

    def _claim(self, path: str) -> bool:
        """Take the pending entries of dead members; returns whether a live one has some."""
        name = stream_name(path)
        consumers: list[dict[str, Any]] = self._commands.xinfo_consumers(name, self._group)
        others = [c for c in consumers if c["name"].decode() != self._consumer]
        self._alone = self._alone and not others
        others = [c for c in others if c["pending"]]
        if not others:
            return False
        leases = self._commands.hgetall(readers_name(path))
        waits = False
        for consumer in others:
            stamp = int(leases.get(f"{self._group}/{consumer['name'].decode()}".encode(), 0)) / 1000
            if not self._take_over and time.time() - stamp < _SILENT_SECONDS:
                waits = True
            else:
                self._claim_from(path, consumer["name"])
        return waits

    def _claim_from(self, path: str, consumer: bytes) -> None:
        name = stream_name(path)
        low = "-"
        while True:
            pending: list[dict[str, Any]] = self._commands.xpending_range(
                name, self._group, low, "+", 1000, consumername=consumer.decode()
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
                    self._claimed.append(Delivery(path, fields[b"f"], token.decode(), tries.get(token, 2)))
            low = "(" + pending[-1]["message_id"].decode()
