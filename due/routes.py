"""Checks where a frame belongs: its key must match the channel it arrived on and the app that wrote it.

    Delivery.path, Frame.key, Frame.app_id ──► Routes.find ──► observations that match the key
                                                    └──► RefusedFrame: "misplaced", "foreign"

 - The segments of the key are the path of the channel or stream, and a frame's key has no wildcards.
 - `due.registration.<app>`, `due.heartbeat.<app>` and `due.health.<app>` come from that app.
 - Elsewhere the third segment is by convention the app's id, but apps write under other names too, and the listing of the paper under none.
   Once the app of that name has written under any such key, no other app may.

A frame's app id is only a claim: any program with write access to the server can use any id.  The server's
access control has to keep programs from impersonating each other.
"""

import threading
from collections.abc import Callable

from due.errors import InvalidKey, RefusedFrame
from due.keys import Key
from due.observation import Observation

_ROUTES = 65536
_OWNERS = 4096
_OWN_ONLY = ("due.registration.", "due.heartbeat.", "due.health.")
_CONTROL = "due"
_OWNER_AT = 2


Route = tuple[str, str, tuple[Observation, ...]]
"""A key's path, the app that may write it as of the last check, and its observations."""


class Routes:
    """The observations of one engine, by key.  Only one thread may call `find`."""

    def __init__(self) -> None:
        self.observations: tuple[Observation, ...] = ()
        self.known: dict[str, Route] = {}
        """Cached routes by key; a frame with the same path and app needs no `find`."""
        self._owners: set[str] = set()
        self._lock = threading.Lock()

    def change(self, change: Callable[[tuple[Observation, ...]], tuple[Observation, ...]]) -> None:
        """Replace the observations by the result of `change`; thread-safe."""
        with self._lock:
            self.observations = change(self.observations)
            self.known = {}

    def find(self, key: str, app_id: str, path: str) -> tuple[Observation, ...]:
        """The observations of a frame that came on `path`; raises `RefusedFrame`."""
        route = self.known.get(key)
        if route is None or route[1] != app_id:
            route = self._made(key, app_id)
        if route[0] != path:
            raise RefusedFrame("misplaced", f"a frame of {key} arrived under {path}")
        return route[2]

    def _made(self, text: str, app_id: str) -> Route:
        try:
            key = Key.parse(text)
        except InvalidKey as error:
            raise RefusedFrame("misplaced", str(error)) from None
        if not key.concrete:
            raise RefusedFrame("misplaced", f"a frame has the key {text!r}: items have no wildcards")
        self._check_writer(key, app_id)
        with self._lock:
            found = tuple(o for o in self.observations if o.key.matches(key))
            if len(self.known) >= _ROUTES:
                self.known = {}
            route = self.known[text] = (key.path, app_id, found)
            return route

    def _check_writer(self, key: Key, app_id: str) -> None:
        owner = key.segments[_OWNER_AT] if len(key.segments) > _OWNER_AT else ""
        if owner == app_id:
            if key.segments[0] != _CONTROL and owner not in self._owners and len(self._owners) < _OWNERS:
                self._owners.add(owner)
                with self._lock:
                    self.known = {}  # until now other apps were allowed to write there
            return
        bound = owner in self._owners if key.segments[0] != _CONTROL else key.path.startswith(_OWN_ONLY)
        if bound:
            raise RefusedFrame("foreign", f"a frame of {key.path} claims to be from {app_id[:64]!r}")
