"""Housekeeping by readers on the server, so that nothing there grows without bound.

    every minute   the end of the streams read here is put off        (streams expire LIFETIME_S after that)
                   leases of members that are gone, and their consumers in the group, are removed
                   paths whose stream has expired leave `due:streams`
    a withdrawn    path's group is destroyed, unless another member of the group lives

Belongs to the thread that renews leases. Each removal is one script on the server that looks again before it acts.
"""

import logging
import time
from collections.abc import Mapping, Sequence
from typing import Any

import redis

from due.drivers.redis_leases import LEFT, LeaseWatch, group_of, lease_field, readers_name
from due.drivers.redis_streams import CARE_SECONDS, LIFETIME_S, STREAMS, stream_name

log = logging.getLogger("due.updates")

_WITHDRAWN_SECONDS = 10.0
_GONE_SECONDS = 30.0
"""A member without a renewed lease for this long does not keep its group alive."""
_FORGET_SECONDS = 120.0
"""A lease unchanged for this long is removed; a member that returns writes it again."""
_SCANNED = 200
_MOST_CANDIDATES = 10_000
_FORGET_LEASE = (
    "return redis.call('HGET',KEYS[1],ARGV[1])==ARGV[2] and redis.call('HDEL',KEYS[1],ARGV[1]) or 0"
)
_FORGET_PATH = "return redis.call('EXISTS',KEYS[1])==0 and redis.call('SREM',KEYS[2],ARGV[1]) or 0"
_FORGET_CONSUMER = """
local pending = redis.call('XPENDING', KEYS[1], ARGV[1], '-', '+', 1, ARGV[2])
if #pending > 0 or redis.call('HEXISTS', KEYS[2], ARGV[3]) == 1 then return 0 end
redis.call('XGROUP', 'DELCONSUMER', KEYS[1], ARGV[1], ARGV[2])
return 1
"""


class Upkeep:
    """Housekeeping by one member of a group.  `tick` and `withdraw` do not raise if the server is away."""

    def __init__(self, commands: Any, group: str, consumer: str) -> None:
        self._commands = commands  # Any: redis-py types an answer by options it cannot see
        self._group = group
        self._consumer = consumer
        self._watches: dict[str, LeaseWatch] = {}
        self._withdrawn: dict[str, tuple[float, LeaseWatch]] = {}
        self._care_at = 0.0
        self._cursor = 0
        self._missing: dict[bytes, float] = {}
        self.counts = {"forgotten_leases": 0, "forgotten_paths": 0, "announced_paths": 0}

    def added(self, path: str) -> None:
        """A path is read from now on: renew the expiry of its stream."""
        self._withdrawn.pop(path, None)
        self._care_at = 0.0

    def withdrawn(self, paths: Sequence[str], now: float) -> None:
        """These paths are not read any more; their group is removed a while later.  `now` as in `tick`."""
        for path in paths:
            self._withdrawn[path] = (now, LeaseWatch(_GONE_SECONDS))
            self._watches.pop(path, None)

    def tick(self, paths: Sequence[str], now: float) -> None:
        """Do what is due; `now`: s, monotonic."""
        try:
            for path, (at, watch) in list(self._withdrawn.items()):
                if now - at > _WITHDRAWN_SECONDS and self._drop_group(path, watch):
                    self._withdrawn.pop(path, None)
            if now >= self._care_at and (paths or self._missing):
                self._care_at = now + CARE_SECONDS
                self._put_off(paths)
                self._tidy(paths)
                self._forget_paths(now)
        except (redis.RedisError, OSError) as error:
            log.debug("housekeeping for the streams of %s failed: %s", self._group, error)

    def _drop_group(self, path: str, watch: LeaseWatch) -> bool:
        """Remove a group; True if it is gone or another living member keeps it."""
        asked = time.monotonic()
        before = {field: watch.value(field) for field in watch.fields()}
        watch.look(self._ours(self._commands.hgetall(readers_name(path))), asked, time.monotonic())
        others = [field for field in watch.fields() if watch.silent(field) < _GONE_SECONDS]
        if not others:
            self._commands.xgroup_destroy(stream_name(path), self._group)
            return True
        return any(before.get(field, watch.value(field)) != watch.value(field) for field in others)

    def _put_off(self, paths: Sequence[str]) -> None:
        pipe = self._commands.pipeline(transaction=False)
        for path in paths:
            pipe.expire(stream_name(path), LIFETIME_S)
            pipe.expire(readers_name(path), LIFETIME_S)
        pipe.execute()

    def _tidy(self, paths: Sequence[str]) -> None:
        self._watches = {path: self._watches.get(path) or self._new_watch() for path in paths}
        for path, watch in self._watches.items():
            asked = time.monotonic()
            leases = self._ours(self._commands.hgetall(readers_name(path)))
            given_up = {field for field in leases if watch.value(field) == LEFT}
            watch.look(leases, asked, time.monotonic())
            for field, value in leases.items():
                if field in given_up or _FORGET_SECONDS < watch.silent(field) < float("inf"):
                    self.counts["forgotten_leases"] += int(
                        self._commands.eval(_FORGET_LEASE, 1, readers_name(path), field, value)
                    )
            self._forget_consumers(path, watch)

    def _new_watch(self) -> LeaseWatch:
        return LeaseWatch(_FORGET_SECONDS, most_per_look=1.5 * CARE_SECONDS)

    def _forget_consumers(self, path: str, watch: LeaseWatch) -> None:
        """Each instance that ever read is a consumer of the group, until it is removed."""
        known = set(watch.fields())
        try:
            consumers = self._commands.xinfo_consumers(stream_name(path), self._group)
        except redis.ResponseError:  # the stream or group is being created again
            return
        for one in consumers:
            field = self._group.encode() + b"/" + one["name"]
            if one["pending"] or field in known or field == lease_field(self._group, self._consumer):
                continue
            names = (stream_name(path), readers_name(path))
            self._commands.eval(_FORGET_CONSUMER, 2, *names, self._group, one["name"], field)

    def _forget_paths(self, now: float) -> None:
        """Paths that were found without a stream at two looks: a producer announces before it appends."""
        self._cursor, paths = self._commands.sscan(STREAMS, self._cursor, count=_SCANNED)
        pipe = self._commands.pipeline(transaction=False)
        looked = list(dict.fromkeys((*paths, *self._missing)))
        for path in looked:
            pipe.exists(b"due:stream:" + path)
        pipe.scard(STREAMS)
        *there, self.counts["announced_paths"] = pipe.execute()
        for path, exists in zip(looked, there, strict=True):
            if exists:
                self._missing.pop(path, None)
            elif now - self._missing.setdefault(path, now) >= CARE_SECONDS:
                del self._missing[path]
                self.counts["forgotten_paths"] += int(
                    self._commands.eval(_FORGET_PATH, 2, b"due:stream:" + path, STREAMS, path)
                )
        while len(self._missing) > _MOST_CANDIDATES:
            self._missing.popitem()

    def _ours(self, leases: Mapping[bytes, bytes]) -> dict[bytes, bytes]:
        ours = self._group.encode()
        return {field: value for field, value in leases.items() if group_of(field) == ours}
