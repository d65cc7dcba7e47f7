"""Housekeeping by readers on the server, so that nothing there grows without bound.

    every minute   the end of the group's leases and lists is put off  (they expire LIFETIME_S after that)
                   the group says again which streams it reads
                   leases of members that are gone, and what the lists keep of them, are removed
    a withdrawn    path's list is deleted, unless another member of the group lives

Belongs to the thread that renews leases. Each removal watches the keys, looks again and acts in one transaction: no
script, because a client that may run scripts can stop the server with one.
"""

import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

import redis

from due.drivers.redis_leases import LEFT, LeaseWatch, lease_name
from due.drivers.redis_streams import CARE_SECONDS, LIFETIME_S, stream_name, wake_name, work_name
from due.drivers.redis_work import WorkLists

log = logging.getLogger("due.updates")

_WITHDRAWN_SECONDS = 10.0
_GONE_SECONDS = 30.0
"""A member without a renewed lease for this long does not keep its group alive."""
_FORGET_SECONDS = 120.0
"""A lease unchanged for this long is removed; a member that returns writes it again."""
_AGAIN_SECONDS = 5.0
_ATTEMPTS = 5
"""Of a transaction whose keys others change meanwhile."""


class Upkeep:
    """Housekeeping by one member of a group.  `tick` and `withdraw` do not raise if the server is away."""

    def __init__(self, commands: Any, group: str, consumer: str) -> None:
        self._commands = commands  # Any: redis-py types an answer by options it cannot see
        self._group = group
        self._consumer = consumer
        self._lists = WorkLists(commands, group)
        self._watches: dict[str, LeaseWatch] = {}
        self._withdrawn: dict[str, tuple[float, LeaseWatch]] = {}
        self._care_at = 0.0
        self.counts = {"forgotten_leases": 0}

    def added(self, path: str) -> None:
        """A path is read from now on: renew the expiry of its leases."""
        self._withdrawn.pop(path, None)
        self._care_at = 0.0

    def withdrawn(self, paths: Sequence[str], now: float) -> None:
        """These paths are not read any more; their lists are deleted a while later.  `now` as in `tick`."""
        for path in paths:
            self._withdrawn[path] = (now, LeaseWatch(_GONE_SECONDS))
            self._watches.pop(path, None)

    def tick(self, paths: Sequence[str], now: float) -> None:
        """Do what is due; `now`: s, monotonic."""
        try:
            for path, (at, watch) in list(self._withdrawn.items()):
                if now - at > _WITHDRAWN_SECONDS and self._drop_group(path, watch):
                    self._withdrawn.pop(path, None)
            if now >= self._care_at and paths:
                self._care_at = now + CARE_SECONDS
                self._put_off(paths)
                self._register(paths)
                self._tidy(paths)
        except (redis.RedisError, OSError) as error:
            log.debug("housekeeping for the streams of %s failed: %s", self._group, error)
            self._care_at = min(self._care_at, now + _AGAIN_SECONDS)

    def _drop_group(self, path: str, watch: LeaseWatch) -> bool:
        """Delete a list; True if it is gone or another living member keeps it."""
        asked = time.monotonic()
        before = {field: watch.value(field) for field in watch.fields()}
        watch.look(self._leases(path), asked, time.monotonic())
        others = [field for field in watch.fields() if watch.silent(field) < _GONE_SECONDS]
        if not others:
            self._lists.drop(path)
            return True
        return any(before.get(field, watch.value(field)) != watch.value(field) for field in others)

    def _put_off(self, paths: Sequence[str]) -> None:
        pipe = self._commands.pipeline(transaction=False)
        for path in paths:
            pipe.expire(lease_name(self._group, path), LIFETIME_S)
            pipe.expire(work_name(self._group, path), LIFETIME_S)
        pipe.expire(wake_name(self._group), LIFETIME_S)
        pipe.execute()

    def _register(self, paths: Sequence[str]) -> None:
        """Only with streams that are there: their producers put off the end of both."""
        pipe = self._commands.pipeline(transaction=False)
        for path in paths:
            pipe.exists(stream_name(path))
        self._lists.register([path for path, there in zip(paths, pipe.execute(), strict=True) if there])

    def _tidy(self, paths: Sequence[str]) -> None:
        self._watches = {path: self._watches.get(path) or self._new_watch() for path in paths}
        for path, watch in self._watches.items():
            asked = time.monotonic()
            leases = self._leases(path)
            given_up = {field for field in leases if watch.value(field) == LEFT}
            watch.look(leases, asked, time.monotonic())
            for field, value in leases.items():
                if field in given_up or _FORGET_SECONDS < watch.silent(field) < float("inf"):
                    self.counts["forgotten_leases"] += self._forget_lease(path, field, value)
            self._forget_consumers(path, watch)

    def _new_watch(self) -> LeaseWatch:
        return LeaseWatch(_FORGET_SECONDS, most_per_look=1.5 * CARE_SECONDS)

    def _forget_consumers(self, path: str, watch: LeaseWatch) -> None:
        """Each instance that ever read is a consumer of the list, until it is removed."""
        known = set(watch.fields())
        try:
            consumers = self._commands.xinfo_consumers(work_name(self._group, path), self._group)
        except redis.ResponseError:  # the list is being made again
            return
        for one in consumers:
            name = one["name"]
            if not (one["pending"] or name in known or name == self._consumer.encode()):
                self._forget_consumer(path, name)

    def _forget_lease(self, path: str, field: bytes, value: bytes) -> int:
        lease = lease_name(self._group, path)

        def act(pipe: Any) -> None:
            if pipe.hget(lease, field) == value:
                pipe.multi()
                pipe.hdel(lease, field)

        return self._transaction(act, lease)

    def _forget_consumer(self, path: str, name: bytes) -> None:
        work, lease = work_name(self._group, path), lease_name(self._group, path)

        def act(pipe: Any) -> None:
            pending = pipe.xpending_range(work, self._group, "-", "+", 1, consumername=name)
            if not pending and not pipe.hexists(lease, name):
                pipe.multi()
                pipe.xgroup_delconsumer(work, self._group, name)

        self._transaction(act, work, lease)

    def _transaction(self, act: Callable[[Any], None], *names: str) -> int:
        """Replies to what `act` queued while the keys stayed as it saw them."""
        for _ in range(_ATTEMPTS):
            with self._commands.pipeline() as pipe:
                try:
                    for name in names:  # one by one: they belong to different rights
                        pipe.watch(name)
                    act(pipe)
                    return len(pipe.execute())
                except redis.WatchError:
                    continue
        return 0

    def _leases(self, path: str) -> dict[bytes, bytes]:
        found: dict[bytes, bytes] = self._commands.hgetall(lease_name(self._group, path))
        return found
