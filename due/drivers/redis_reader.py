"""Reading reliable streams as a member of a group, and the pending work of the dead.

    XREAD: new payloads ──► ids onto the group's work list ──► XREADGROUP: which of them are ours ──► deliveries
                                                                        └─ not read by us: XRANGE

One request is outstanding at a time; acknowledgements travel with the next request.  Order: before
reading what is new, a path's pending entries come first: our own after a reconnect, and those of
members that died.  While another member that still lives has pending entries, a standby member holds.
A member is dead when this one has watched its lease unchanged for 3 s (see `redis_leases`).
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import hiredis
import redis

from due.drivers.base import NO_RIGHT, Delivery, app_of
from due.drivers.redis_acks import Acknowledgements
from due.drivers.redis_aside import Aside
from due.drivers.redis_dead_members import SILENT_SECONDS, DeadMembers
from due.drivers.redis_leases import MemberLeases
from due.drivers.redis_places import GroupPlaces
from due.drivers.redis_primary import backoff_for
from due.drivers.redis_share import StreamShare
from due.drivers.redis_streams import stream_name, wake_name, work_name
from due.drivers.redis_upkeep import Upkeep
from due.drivers.redis_wire import Wire, pack, understood
from due.drivers.redis_work import (
    MOST_GIVEN,
    AnswerSize,
    ReadAhead,
    ReadRound,
    last_id,
    list_gone,
    packed_ids,
    packed_payload,
    put_before,
    seconds_of,
)
from due.errors import UpdatesUnavailable
from due.logs import without_passwords

log = logging.getLogger("due.updates")

_BLOCK_MS = 1000
_LOOK_SECONDS = 1.0
"""Seconds between two checks of the other members; a single member checks less often."""
_HOLD_SECONDS = 0.2
_MOST_PATHS = 4096
"""Most streams that one member reads, because any program may announce paths."""
_TOO_MANY = "%s reads at most %d reliable paths: %s and others are left out; observe a narrower key"
_STREAM = stream_name("")
_Expected = tuple[str, str, str]
"""Kind of an answer, path, id."""
_ACK, _NEW, _AHEAD, _OURS, _HISTORY = ((kind, "", "") for kind in ("ack", "new", "ahead", "ours", "history"))


class StreamReader:
    """A member of a group of readers.  `read`, `acknowledge` and `care` belong to one thread."""

    def __init__(self, url: str, commands: Any, group: str, consumer: str, *, shared: bool) -> None:
        self._url, self._place = url, without_passwords(url)
        self._commands = commands  # Any: redis-py types an answer by options it cannot see
        self._group = group
        self._consumer = consumer
        self._shared = shared
        self._lock = threading.Lock()
        self._paths: dict[str, str] = {}
        self._wire: Wire | None = None
        self._expected: deque[_Expected] = deque()
        self._at: dict[str, str] = {}
        """Up to where the ids of a stream are on the work list, as far as is known here."""
        self._found, self._read_ahead = ReadRound(), ReadAhead()
        self._size = AnswerSize(fixed=shared)  # whoever takes more at once leaves less to the others
        self._woken = "0-0"
        self._listless = self._ask_lists = False
        """A work list is gone; lists may hold ids of a member that died before it asked for them."""
        self._acks = Acknowledgements(group)
        self._catch_up: set[str] = set()
        self._requested: tuple[str, ...] = ()
        self._held: set[str] = set()
        self._making: set[str] = set()
        """Paths that are being added: their lists are not there yet, and not gone."""
        self._leases = MemberLeases(commands, group, consumer)
        self._share = StreamShare()
        self._places = GroupPlaces(commands, group)
        self._dead = DeadMembers(commands, group, consumer)
        self._upkeep = Upkeep(commands, group, consumer)
        self.aside = Aside(commands, app_of(group))
        self._look_at, self._alone = 0.0, False
        self._quiet = False
        """Whether the server can suppress the reply to an XACK."""
        self._claimed: deque[Delivery] = deque()
        self._backoff = backoff_for(url)
        self._life = b""
        self._active = True
        self._take_over = self._stale = False
        self._denied: set[str] = set()
        """Paths without a right to read them."""
        self._counts = {"claimed": 0, "vanished": 0, "paths_refused": 0, "paths_denied": 0}

    def add(self, path: str, start: str, *, reset: bool = False) -> None:
        """Read this stream too; `start` counts if the group has no work list of it, or `reset`."""
        with self._lock:
            if path in self._denied or (path in self._paths and not reset):
                return
            if len(self._paths) >= _MOST_PATHS and path not in self._paths:
                self._refuse(path)
                return
            self._paths[path] = start
            self._upkeep.added(path)
            self._held.add(path)
            self._making.add(path)
            self._look_at = 0.0
            self._stale = True
        try:
            self._make_list(path, start, reset=reset)
        finally:
            self._making.discard(path)
        self.renew()
        self._register([path])
        self._interrupt()

    def leave(self, stays: Callable[[str], bool]) -> None:
        """Stop reading paths without an observation."""
        with self._lock:
            gone = [path for path in self._paths if not stays(path)]
            for path in gone:
                del self._paths[path]
                self._at.pop(path, None)
                self._held.discard(path)
                self._places.unmade.pop(path, None)
                self._dead.forget(path)
            self._stale = bool(gone)
            self._upkeep.withdrawn(gone, time.monotonic())
        self._leases.give_up(gone)
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

    def share(self, shards: frozenset[str] | None) -> None:
        """See `Receiver.share`."""
        with self._lock:
            gained = self._share.change(shards, self._paths)
            self._held.update(gained)
            self._look_at = 0.0 if gained else self._look_at
            self._stale = True
        self._interrupt()

    def offered(self) -> tuple[str, ...]:
        """See `Receiver.offered`."""
        with self._lock:
            return tuple(sorted(self._paths))

    def held(self) -> tuple[str, ...]:
        """See `Receiver.held`."""
        return self._share.held(self.offered() if self._active else ())

    def abandon(self, path: str) -> None:
        """See `Receiver.abandon`."""
        self._share.abandon(path)
        try:
            self._dead.release(path)
        except (redis.RedisError, OSError) as error:
            log.warning("entries of %s stay with this member until it ends: %s", path, error)

    def fileno(self) -> int:
        """For select; -1 while there is nothing to wait for."""
        return self._wire.fileno() if self._wire is not None else -1

    @property
    def primary(self) -> str:
        """HOST:PORT of the server that the streams are read from; empty: none."""
        return self._wire.primary if self._wire is not None else ""

    def move(self, successor: str) -> None:
        """Another server is the primary now."""
        if self.primary not in ("", successor):
            self._lose(UpdatesUnavailable(f"{successor} is the primary now"))

    def patience(self) -> float:
        """How long `receive` may wait at most, seconds."""
        if self._claimed:
            return 0.0
        if not self._paths or not self._active:
            return 60.0
        return 0.05 if self._wire is None else _HOLD_SECONDS if self._waits() else _LOOK_SECONDS

    def care(self) -> None:
        """Take over from dead members, reconnect, and request more; called before each wait."""
        if not self._paths or not self._active:
            self._flush_acks()
            return
        now = time.monotonic()
        if now >= self._look_at:
            usual = SILENT_SECONDS if self._alone else _LOOK_SECONDS
            self._look_at = now + (_HOLD_SECONDS if self._waits() else usual)
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
        self._acks.done(delivery)
        self._share.done(delivery)

    def renew(self) -> None:
        """Renew the leases; a standby instance keeps the group's position, too."""
        self._leases.renew(lambda: list(self._paths))
        self._upkeep.tick(list(self._paths), time.monotonic())

    def statistics(self) -> dict[str, int]:
        """Counters for `health`."""
        sizes = {"held_paths": len(self._held), "read_paths": len(self._paths)}
        return {**self._counts, **sizes, **self.aside.counts, **self._upkeep.counts}

    def close(self) -> None:
        """Acknowledge what is done, give up the leases for good, close."""
        self._flush_acks()
        with self._lock:
            paths, self._paths = list(self._paths), {}
        self._leases.give_up(paths)
        self._hang_up()

    def _hang_up(self) -> None:
        if self._wire is not None:
            self._wire.close()
            self._wire = None

    def _waits(self) -> bool:
        with self._lock:
            return any(map(self._share.reads, self._held))

    def _refuse(self, path: str) -> None:
        self._counts["paths_refused"] += 1
        if self._counts["paths_refused"] == 1:
            log.error(_TOO_MANY, self._group, _MOST_PATHS, path)

    def _deny(self, path: str, error: Exception) -> None:
        """A right is missing: this path is left out, and the others are read on."""
        with self._lock:
            self._paths.pop(path, None)
            self._at.pop(path, None)
            self._held.discard(path)
            if len(self._denied) < _MOST_PATHS:
                self._denied.add(path)
        self._counts["paths_denied"] += 1
        log.error(NO_RIGHT, self._group, f"read {path}", error)

    def _make_list(self, path: str, start: str, *, reset: bool = False, since: float | None = None) -> None:
        """See `GroupPlaces.make`."""
        self._at.pop(path, None)
        try:
            self._places.make(path, start, reset=reset, since=since)
        except redis.exceptions.NoPermissionError as error:
            self._deny(path, error)
        self._at.pop(path, None)

    def _register(self, paths: Sequence[str]) -> None:
        self._places.register([path for path in paths if path in self._paths])

    def _interrupt(self) -> None:
        """Make the server answer the blocked request now, so that a new one goes out."""
        if self._wire is not None and self._expected:
            try:
                self._commands.xadd(wake_name(self._group), {"i": self._consumer}, maxlen=1)
            except (redis.RedisError, OSError) as error:
                log.debug("the reader could not be interrupted: %s", error)

    def _connect(self) -> None:
        wire = Wire(self._url)
        life = wire.life()
        with understood("TIME"):
            now = seconds_of(wire.call("TIME"))
            self._places.server_time.note(now)
            self._woken = f"{int(now * 1000) - 1}-0"
        self._quiet = wire.call("CLIENT", "REPLY", "ON") == b"OK"
        self._backoff.succeeded()
        self._wire = wire
        self._expected.clear()
        self._read_ahead, self._found = ReadAhead(), ReadRound()
        self._at.clear()
        self._acks.lost()
        self._share.answered()
        with self._lock:
            paths = list(self._paths)
            self._catch_up = set(paths if self._life else ())
        before, self._life = self._life, life
        if before not in (b"", life):
            self._begin_elsewhere(paths)

    def _begin_elsewhere(self, paths: Sequence[str]) -> None:
        """The server may know less of this group than we have done, or nothing: producers have to hear that it reads."""
        self._acks.forget()
        self._commands.connection_pool.disconnect(inuse_connections=False)  # they lead to the old one
        for path in paths:
            self._upkeep.added(path)
        self.renew()
        self._register(paths)

    def _lose(self, error: Exception) -> None:
        self._hang_up()
        delay = self._backoff.failed(time.monotonic())
        log.warning("streams at %s: %s; retrying in %.2f s", self._place, error, delay)

    def _request(self, wire: Wire) -> None:
        with self._lock:
            self._stale = False
            self._catch_up &= self._paths.keys()
            history = tuple(self._catch_up)
            if not self._active:  # became a standby a moment ago
                history = ()
            readable = self._paths if self._active else ()
            paths = history or tuple(p for p in readable if p not in self._held and self._share.ask(p))
        command = self._packed_acks(quietly=self._quiet and bool(paths))
        self._requested = paths
        if self._ask_lists:
            self._ask_lists = False
            self._at.clear()
        at = {path: self._at.get(path, "") for path in paths}  # other threads forget places
        unplaced = () if history else tuple(path for path, place in at.items() if not place)
        if history:
            command += self._packed_work(history, b"0")
        elif unplaced:
            command += self._packed_work(unplaced, b">")
            for path in unplaced:
                command += pack((b"XINFO", b"STREAM", work_name(self._group, path)))
                self._expected.append(("place", path, ""))
        elif paths:
            wait = () if self._stale else (b"BLOCK", _BLOCK_MS)
            names = (*map(stream_name, paths), wake_name(self._group))
            places = (*at.values(), self._woken)
            command += pack((b"XREAD", b"COUNT", self._size.count, *wait, b"STREAMS", *names, *places))
            self._expected.append(_NEW)
        if command:
            wire.send_packed(command)

    def _packed_work(self, paths: Sequence[str], since: bytes, most: int = MOST_GIVEN) -> bytes:
        """Ask the work lists for ids that wait, or with `0` for those that are ours already."""
        self._size.asked(most, time.monotonic())
        self._expected.append(_HISTORY if since == b"0" else _OURS)
        head = (b"XREADGROUP", b"GROUP", self._group, self._consumer, b"COUNT", most, b"STREAMS")
        return pack((*head, *(work_name(self._group, path) for path in paths), *((since,) * len(paths))))

    def _packed_acks(self, *, quietly: bool = False) -> bytes:
        """`quietly`: a read follows, so replies of their own would only cause wake-ups."""
        command, replies = self._acks.packed(quietly=quietly)
        self._expected.extend([_ACK] * replies)
        return command

    def _flush_acks(self) -> None:
        if self._wire is None or not self._acks:
            return
        try:
            self._wire.send_packed(self._packed_acks())
        except UpdatesUnavailable as error:
            self._lose(error)

    def _reply(self, reply: Any) -> list[Delivery]:
        expected = self._expected.popleft() if self._expected else _ACK
        if isinstance(reply, hiredis.ReplyError):
            self._refused(reply, expected)
        else:
            with understood("a request for entries"):
                self._answered(reply, expected)
        if expected[0] != "put" and _ACK not in self._expected:
            self._acks.answered()
        if len(self._expected) > 1 or (self._expected and self._expected[0] != _AHEAD):
            return []
        if self._listless and not self._expected:
            self._listless = False
            self._begin_again()
        return self._handed_out()

    def _answered(self, reply: Any, expected: _Expected) -> None:
        kind, path, token = expected
        if expected == _NEW:
            self._put(reply)
        elif expected == _AHEAD:
            self._came_ahead(reply)
        elif kind == "still":
            self._still_next(path, reply)
        elif expected in (_OURS, _HISTORY):
            self._given(reply, again=expected == _HISTORY)
        elif kind == "place":
            self._placed(path, reply)
        elif kind == "payload" and reply:
            self._found.payloads[path, token] = reply[0][1][1]

    def _put(self, reply: Any) -> None:
        """Put the ids of new entries on the work lists, and ask which of them are ours, and for what comes next."""
        found: dict[str, list[str]] = {}
        for name, entries in reply or ():
            if name == wake_name(self._group).encode():
                self._woken = entries[-1][0].decode()
                self._at.clear()  # a list may have been moved
                return
            path = name.decode()[len(_STREAM) :]
            unread = path not in self._at or path in self._held or not self._active
            if unread or not self._share.ask(path):
                self._at.pop(path, None)
                continue
            found[path] = [token.decode() for token, _ in entries]
            for token, fields in entries:
                self._found.payloads[path, token.decode()] = fields[1]
        if not found or self._wire is None or self._listless:
            return
        self._size.came(max(map(len, found.values())), self._found.size())
        command = self._packed_acks(quietly=self._quiet)
        for path, tokens in found.items():
            command += b"".join(packed_ids(self._group, path, tokens))
            self._expected.extend([("put", path, "")] * len(tokens))
            self._at[path] = tokens[-1]
        command += self._packed_work(list(found), b">", self._size.most_given)
        if not (self._shared or self._ask_lists):  # in a shared group others would read the same
            command += self._packed_ahead()
        self._wire.send_packed(command)

    def _came_ahead(self, reply: Any) -> None:
        """Use what was read ahead; of what was long on its way, first ask whether it still comes next."""
        paths = [name.decode()[len(_STREAM) :] for name, _ in reply or ()]
        if self._read_ahead.comes_next(paths, self._at):
            self._put(reply)
        elif paths and self._wire is not None:
            self._read_ahead.late = reply
            self._expected.extend(("still", path, "") for path in paths)
            asked = (pack((b"XINFO", b"STREAM", work_name(self._group, path))) for path in paths)
            self._wire.send_packed(b"".join(asked))

    def _still_next(self, path: str, reply: Any) -> None:
        """Whether a list still ends where a stream was read ahead from; with the last answer what does is put on it."""
        before = self._read_ahead.places.get(path, "")
        if path in self._paths and last_id(reply) == before:
            self._at[path] = before
        else:
            self._at.pop(path, None)
        if not (self._expected and self._expected[0][0] == "still"):
            self._put(self._read_ahead.take())

    def _packed_ahead(self) -> bytes:
        """Ask for what comes next, to be there when the callbacks have returned; does not wait."""
        at = {path: place for path in self._requested if (place := self._at.get(path))}
        self._expected.append(_AHEAD)
        self._read_ahead = ReadAhead(at)
        return pack((b"XREAD", b"COUNT", self._size.count, b"STREAMS", *map(stream_name, at), *at.values()))

    def _given(self, reply: Any, *, again: bool) -> None:
        """Note which ids are ours, and ask for payloads that others have put on the list."""
        self._size.answered(time.monotonic())
        found = set()
        for name, entries in reply or ():
            path = name.decode().rpartition(":")[2]
            if entries:
                found.add(path)
            for token, fields in entries:
                if fields:
                    self._found.ours.append((path, token.decode()))
                else:
                    self._acks.add(path, token.decode())  # somebody took it off the list
            if len(entries) >= self._size.most_asked:
                self._at.pop(path, None)  # there may be more
        if again:
            self._catch_up &= found
        missing = self._found.missing()
        if missing and self._wire is not None:
            self._expected.extend(("payload", path, token) for path, token in missing)
            self._wire.send_packed(b"".join(map(packed_payload, missing)))

    def _placed(self, path: str, reply: Any) -> None:
        """What is not on the work list comes behind the last id that was."""
        if path in self._paths:
            self._at[path] = last_id(reply)

    def _handed_out(self) -> list[Delivery]:
        """What is ours, in order; called when nothing is expected any more."""
        found, self._found = self._found, ReadRound()
        for path, token in found.missing():
            self._vanished(path, token)
        if self._shared and found.ours:
            self._at.clear()  # others have put more on the lists while we process
        deliveries = [
            Delivery(path, found.payloads[path, token], self._acks.token(token))
            for path, token in found.ours
            if (path, token) in found.payloads
        ]
        self._share.given(deliveries)
        self._share.answered()
        return deliveries

    def _vanished(self, path: str, token: str) -> None:
        """Its producer has deleted it, which waited for the group as long as it was told to."""
        self._counts["vanished"] += 1
        self._acks.add(path, token)

    def _refused(self, error: Exception, expected: _Expected) -> None:
        if expected[0] == "put" and put_before(error):
            return
        if list_gone(error):
            self._listless = True
        elif str(error).startswith("NOPERM"):
            self._drop_denied()
        else:
            raise UpdatesUnavailable(f"reading streams was refused: {error}")

    def _begin_again(self) -> None:
        """A work list is gone because the server restarted empty: begin at the stream's beginning."""
        paths = [path for path in self.offered() if path not in self._making]
        for path in paths:
            self._make_list(path, "0")
        with self._lock:
            self._held.update(self._places.unmade)  # a new primary may take no writes yet
            self._look_at = 0.0
        self.renew()
        self._register(paths)
        self._catch_up.clear()
        self._at.clear()

    def _drop_denied(self) -> None:
        """Rights were taken away from one of the paths of a request: find it."""
        for path in self._requested:
            try:
                self._places.lists.check_right(path)
            except redis.exceptions.NoPermissionError as error:
                self._deny(path, error)
            except (redis.RedisError, OSError):
                continue  # it is found with the next request

    def _look_after_the_dead(self) -> None:
        paths = self.offered()
        self._ask_lists = True  # with the next request: what is on its way may have taken long
        self._alone, gone = True, False
        for path in paths:
            unmade = self._places.unmade.get(path)
            if unmade is not None:
                self._make_list(path, unmade[0], reset=unmade[1], since=unmade[2])
            if not self._share.reads(path):
                continue
            try:
                waits = self._claim(path)
            except (redis.RedisError, OSError) as error:
                log.debug("members of %s could not be checked: %s", path, error)
                self._alone = False
                gone = gone or (list_gone(error) and path not in self._making | self._places.unmade.keys())
                continue
            if not waits or self._shared:
                with self._lock:
                    self._held.discard(path)
        self._take_over = False
        if gone:  # while this member rested, so that no answer to a request told it
            self._begin_again()

    def _claim(self, path: str) -> bool:
        """Take the pending entries of dead members; returns whether a live one has some."""
        found = partial(self._take_claimed, path)
        alone, waits = self._dead.claim(path, found, even_the_living=self._take_over)
        self._alone = self._alone and alone
        return waits

    def _take_claimed(self, path: str, token: str, payload: bytes | None, tries: int) -> None:
        if payload is None:
            self._vanished(path, token)
            return
        self._counts["claimed"] += 1
        self._claimed.append(Delivery(path, payload, self._acks.token(token), tries))
        self._share.given([self._claimed[-1]])
