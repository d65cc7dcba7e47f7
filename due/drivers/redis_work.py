"""Work lists: how far a group is with a stream that many groups read, in a key that no other app may write.

    due:stream:<path>          payloads: written by its producers, and only read by its readers
    due:work:<group>:<path>    their ids, for one group: what waits, who has what, how often it was delivered
    due:readers:<path>         the groups that read a stream: each adds its own name

A member reads new payloads, puts their ids on its group's list, and processes those that the list gives to it.  An id
is put there once, by whichever member is first, because the server takes ids in ascending order only.
"""

import time
from collections.abc import Iterable, Mapping
from typing import Any

import redis

from due.drivers.redis_streams import (
    PRODUCERS,
    announced_name,
    parse_id,
    readers_name,
    stream_name,
    wake_name,
    work_name,
)
from due.drivers.redis_wire import pack
from due.errors import UpdatesUnavailable

COUNT = 32
"""Most entries of a stream in one answer, where the server is near or they are large."""
MOST_COUNT = 512
"""Most in one answer anywhere."""
MOST_ANSWER_BYTES = COUNT * (96 << 10)
"""More entries are asked for only while an answer holds less than this: as many bytes as frames of the usual size."""
SLOW_SECONDS = 0.01
"""A round trip that takes longer is worth more entries."""
FRESH_SECONDS = 0.05
"""What was read ahead is used at once within this time; after it only if nobody has moved the list since."""
MOST_GIVEN = 2 * COUNT
"""Most ids that a list gives at once: what was just put there, and what others have left."""
_BEGINNING = (0, 0)
_MOST_OPEN = 65_536
_ATTEMPTS = 5
_MOST_PRODUCERS = 4096
"""Most apps whose announcements are read, because any program may name one."""
_REPEATED = "equal or smaller"
_MOST_NUMBER = 2**64 - 1


def packed_ids(group: str, path: str, tokens: Iterable[str]) -> list[bytes]:
    """Commands that put ids on a group's list."""
    name = work_name(group, path)
    return [pack((b"XADD", name, b"NOMKSTREAM", token, b"i", b"")) for token in tokens]


def packed_done(group: str, path: str, tokens: Iterable[str]) -> list[bytes]:
    """Commands that take ids off a group's list."""
    name, done = work_name(group, path), tuple(tokens)
    return [pack((b"XACK", name, group, *done)), pack((b"XDEL", name, *done))]


def packed_payload(place: tuple[str, str]) -> bytes:
    """The command that reads one payload, of a path and an id."""
    path, token = place
    return pack((b"XRANGE", stream_name(path), token, token))


def announced_paths(commands: Any) -> list[str]:
    """Paths of all streams that producers announced; raises redis.RedisError and OSError."""
    apps = sorted(commands.smembers(PRODUCERS))[:_MOST_PRODUCERS]
    pipe = commands.pipeline(transaction=False)
    for app in apps:
        pipe.zrange(announced_name(app.decode("ascii", "replace")), 0, -1)
    found = pipe.execute(raise_on_error=False)
    paths = {path for one in found if isinstance(one, list) for path in one}
    return sorted(path.decode("ascii", "replace") for path in paths)


def put_before(error: Exception) -> bool:
    """Whether an id was refused because another member had put it on the list already."""
    return _REPEATED in str(error)


def list_gone(error: Exception) -> bool:
    """Whether a command about a list failed because the server does not have it."""
    return "NOGROUP" in str(error) or "no such key" in str(error)


def last_id(reply: Any) -> str:
    """The last id of a list, from `XINFO STREAM`."""
    last: bytes = dict(zip(reply[::2], reply[1::2], strict=True))[b"last-generated-id"]
    return last.decode()


class AnswerSize:
    """How many entries to ask for: on a long way more of them if they are small.  Times are seconds, monotonic.

    Args:
        fixed: always the same.
    """

    def __init__(self, *, fixed: bool = False) -> None:
        self._most = COUNT if fixed else MOST_COUNT
        self.count = COUNT
        """Entries of each stream."""
        self.most_asked = MOST_GIVEN
        """Ids that the last question to the work lists asked for."""
        self._asked = self._lap = 0.0

    @property
    def most_given(self) -> int:
        """Ids that a list gives at once: see `MOST_GIVEN`."""
        return 2 * self.count

    def asked(self, most: int, now: float) -> None:
        """A question to the work lists is sent."""
        self.most_asked, self._asked = most, now

    def answered(self, now: float) -> None:
        """Its answer has come."""
        self._lap = now - self._asked

    def came(self, entries: int, size: int) -> None:
        """An answer held so many entries of one stream, and so many bytes of all."""
        if size > MOST_ANSWER_BYTES or 4 * entries < self.count:
            self.count = max(COUNT, self.count // 2)
        elif entries >= self.count and 2 * size <= MOST_ANSWER_BYTES and self._lap > SLOW_SECONDS:
            self.count = min(self._most, 2 * self.count)


class ReadRound:
    """What one round of requests has brought so far, by path and id."""

    def __init__(self) -> None:
        self.payloads: dict[tuple[str, str], bytes] = {}
        """Of this group's members whoever is given the id processes them."""
        self.ours: list[tuple[str, str]] = []
        """What the work lists gave to this member."""

    def size(self) -> int:
        """Bytes of the payloads."""
        return sum(map(len, self.payloads.values()))

    def missing(self) -> list[tuple[str, str]]:
        """What is ours and was not read here."""
        return [one for one in self.ours if one not in self.payloads]


class ReadAhead:
    """What was asked for while callbacks were to run, behind the ids of `places` by path."""

    def __init__(self, places: Mapping[str, str] | None = None) -> None:
        self.places = places or {}
        self.late: list[Any] = []
        """What came late, as on a slow link, until it is known whether it still comes next."""
        self._asked = time.monotonic()

    def comes_next(self, paths: Iterable[str], at: Mapping[str, str]) -> bool:
        """Whether what came for these paths can be put on the lists, which end where `at` says."""
        fresh = time.monotonic() - self._asked < FRESH_SECONDS
        return fresh and all(at.get(path) == self.places.get(path) for path in paths)

    def take(self) -> list[Any]:
        """What came late; nothing from then on."""
        late, self.late = self.late, []
        return late


class WorkLists:
    """One group's lists on the server.  Methods raise redis.RedisError and OSError."""

    def __init__(self, commands: Any, group: str) -> None:
        self._commands = commands  # Any: redis-py types an answer by options it cannot see
        self._group = group

    def register(self, paths: Iterable[str]) -> None:
        """Say that the group reads these streams: their producers wait for it while a member renews its lease."""
        pipe = self._commands.pipeline(transaction=False)
        for path in paths:
            pipe.sadd(readers_name(path), self._group)
        pipe.execute()

    def make(self, path: str, start: str, *, reset: bool) -> None:
        """Make the group's list of a stream, if there is none.

        Args:
            path: of the stream.
            start: what counts as done: `$`: all that is there, otherwise up to this id, at most what is there. A place
                that a producer keeps for the group is more exact than either.
            reset: set a list that is there to `start`; what its members have not acknowledged stays.
        """
        name = work_name(self._group, path)
        for _ in range(_ATTEMPTS):
            with self._commands.pipeline() as pipe:
                try:
                    pipe.watch(name)
                    there = pipe.exists(name)
                    if there and not reset:
                        return
                    begin = self._position(path, start, kept=not reset)
                    waiting = self._open(name, begin) if there else []
                    pipe.multi()
                    pipe.delete(name)
                    for token in waiting:
                        pipe.xadd(name, {"i": b""}, id=token)
                    place = f"{begin[0]}-{begin[1]}"
                    pipe.xgroup_create(name, self._group, "0" if waiting else place, mkstream=True)
                    if begin != _BEGINNING:
                        pipe.execute_command("XSETID", name, place)
                    if there:
                        pipe.xadd(wake_name(self._group), {"i": "moved"}, maxlen=1)
                    pipe.execute()
                except redis.WatchError:
                    continue
                return

    def drop(self, path: str) -> None:
        """Delete the group's list: it reads this stream no more."""
        self._commands.delete(work_name(self._group, path))

    def take(self, path: str, member: str, tries: dict[bytes, int]) -> list[tuple[str, bytes | None]]:
        """Claim ids for a member; with their payloads, in order; None: its producer has it no more."""
        claimed = self._commands.xclaim(work_name(self._group, path), self._group, member, 0, list(tries))
        tokens = [token.decode() for token, fields in claimed if fields]
        pipe = self._commands.pipeline(transaction=False)
        for token in tokens:
            pipe.xrange(stream_name(path), token, token)
        found = pipe.execute()
        # the decoder refuses entries of other programs
        payloads = [entries[0][1].get(b"f", b"") if entries else None for entries in found]
        return list(zip(tokens, payloads, strict=True))

    def check_right(self, path: str) -> None:
        """Raises NoPermissionError where the group may not read a stream."""
        self._commands.xrange(stream_name(path), "+", "+", count=1)

    def _open(self, name: str, end: tuple[int, int]) -> list[bytes]:
        """Ids up to `end` that members have not acknowledged."""
        if end == _BEGINNING:
            return []
        found = self._commands.xpending_range(name, self._group, "-", f"{end[0]}-{end[1]}", _MOST_OPEN)
        return [one["message_id"] for one in found]

    def _position(self, path: str, start: str, *, kept: bool) -> tuple[int, int]:
        try:
            last = parse_id(self._commands.xinfo_stream(stream_name(path))["last-generated-id"])
        except redis.exceptions.NoPermissionError:
            raise
        except redis.ResponseError:  # no such stream: whatever will be there is new
            return _BEGINNING
        place = self._kept_place(path) if kept else None
        if place is None:
            place = last if start == "$" else parse_id(start)
        return min(place, last)

    def _kept_place(self, path: str) -> tuple[int, int] | None:
        """Where a producer, or the group itself under an earlier version, has left the group on the stream."""
        name = stream_name(path)
        for group in self._commands.xinfo_groups(name):
            if group["name"] == self._group.encode():
                if not group["pending"]:
                    return parse_id(group["last-delivered-id"])
                return _before(parse_id(self._commands.xpending(name, self._group)["min"]))
        return None


def _before(place: tuple[int, int]) -> tuple[int, int]:
    ms, number = place
    if number:
        return ms, number - 1
    if not ms:
        raise UpdatesUnavailable("the server gave 0-0 for an entry's id")
    return ms - 1, _MOST_NUMBER


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


def seconds_of(reply: Any) -> float:
    """What `TIME` says, in unix seconds."""
    return int(reply[0]) + int(reply[1]) / 1e6
