"""A group's places on streams: its work lists, each made as soon as the server lets it be."""

import logging
import time
from typing import Any

import redis

from due.drivers.redis_work import ServerTime, WorkLists

log = logging.getLogger("due.updates")

_TRIES = 3
"""Immediate attempts to make a list, in case the connection was just lost."""


class GroupPlaces:
    """Belongs to one member of the group."""

    def __init__(self, commands: Any, group: str) -> None:
        self.lists = WorkLists(commands, group)
        self.server_time = ServerTime(commands)
        self.unmade: dict[str, tuple[str, bool, float]] = {}
        """Work lists that could not be made: start, and since when; their streams are not read before that."""
        self._group = group

    def register(self, paths: list[str]) -> None:
        """See `WorkLists.register`; said again by the housekeeping where it fails."""
        try:
            self.lists.register(paths)
        except (redis.RedisError, OSError) as error:
            log.debug("readers could not be told: %s", error)

    def make(self, path: str, start: str, *, reset: bool = False, since: float | None = None) -> None:
        """Make the group's list of a stream; where that fails now, it is left in `unmade`.

        Args:
            path: of the stream.
            start, reset: as in `WorkLists.make`.
            since: when the list was first requested, if it could not be made then (s, monotonic).

        Raises:
            redis.exceptions.NoPermissionError: the group may not read the stream.
        """
        for _ in range(_TRIES):
            try:
                begin = self.server_time.start(since) if start == "$" and since is not None else start
                self.lists.make(path, begin, reset=reset)
            except redis.exceptions.NoPermissionError:
                self.unmade.pop(path, None)
                raise
            except (redis.RedisError, OSError) as error:
                failed = error
                continue
            self.unmade.pop(path, None)
            return
        log.warning("the place of %s on %s is not kept yet, trying again: %s", self._group, path, failed)
        # entries from now on are wanted, even if the list is made later
        self.unmade[path] = (start, reset, time.monotonic() if since is None else since)
