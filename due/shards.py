"""What an instance of a sharded app does with its shards: load state, save it, acknowledge, hand over.

    first frame of a path ──► load ──► frames … ──► save ──► acknowledged ──► … ──► save ──► another instance's
                               └── not now: frames wait

With a `ShardState`, frames are acknowledged when the state that contains them is saved.  So whoever gets the path next,
also after a kill -9, begins with the saved state and is sent every later frame.  The place that is saved with the state
says which frames it contains: those that come again are dropped, and each frame counts exactly once.

An instance that was suspended while another one got its shard neither saves nor acknowledges: it lets go.  What it had
sent to the archive before is told by the number of its grant, which is lower than that of its successor.
"""

import logging
import time
from typing import Any, Protocol

import msgspec

from due.drivers.base import Delivery, Receiver
from due.errors import BackendError, DecodeError, Superseded
from due.membership import Standing
from due.tracker import Tracker

log = logging.getLogger("due")

_MOST_UNSAVED = 4 << 20
"""Bytes of a path that may wait for its state to be saved; a producer waits when it has kept four times as many."""
_RETRY_SECONDS = 0.5
_MOST_KEYS = 65_536

Place = dict[str, Any]
"""Which frames a state contains: a plain value, to be archived with the state."""


class ShardState(Protocol):
    """The state of a sharded app, by path.  Called in the dispatcher thread, between frames.

    Where `load` or `save` raises a `BackendError` it is called again later; whatever else they raise ends the process,
    and another instance takes over what was saved last.
    """

    def load(self, path: str) -> Place | None:
        """Take up a path with the state that was saved last.

        Args:
            path: of a key, without specs.

        Returns:
            The place that was saved with the state; None: there is no state, begin anew.
        """
        ...

    def save(self, path: str, place: Place) -> None:
        """Store the state of a path and its place, in one piece.  On return both are durable."""
        ...

    def drop(self, path: str) -> None:
        """Another instance works on this path from now on."""
        ...


class ShardOwner(Protocol):
    """Says which shards are this instance's; thread-safe."""

    def standing(self, shard: str, grant: int) -> Standing:
        """What may be done with a shard that was got by a grant; 0: without one."""
        ...

    def grant(self, shard: str) -> int:
        """The number of the present grant of a shard; 0: none."""
        ...

    def let_go(self, shard: str) -> None:
        """Nothing of a lost shard is left here."""
        ...


class _HeldPath:
    """A path that this instance works on."""

    def __init__(self, shard: str, grant: int) -> None:
        self.shard = shard
        self.grant = grant
        self.number = grant
        """Is saved with the state; higher than those of all earlier instances."""
        self.loaded = False
        self.due = 0.0
        """When to try to load, or to save, again."""
        self.waiting: list[Delivery] = []
        """What came before the state was loaded."""
        self.unsaved: list[Delivery] = []
        self.unsaved_bytes = 0


class ShardWork:
    """Belongs to the dispatcher thread.

    Args:
        receiver: acknowledges.
        tracker: knows which frames were seen.
        owner: says which shards are this instance's.
    """

    def __init__(self, receiver: Receiver, tracker: Tracker, owner: ShardOwner) -> None:
        self._receiver = receiver
        self._tracker = tracker
        self._owner = owner
        self._state: ShardState | None = None
        self._every = 0.0
        self._paths: dict[str, _HeldPath] = {}
        self._review = False
        self.counts = {"shard_loads": 0, "shard_saves": 0, "shard_failures": 0, "shards_lost": 0}

    def keep(self, state: ShardState, every: float) -> None:
        """From now on keep state, saved every so many seconds."""
        self._state, self._every = state, every

    def changed(self) -> None:
        """Shards may have been given or taken: see to it in the next `turn`.  Any thread."""
        self._review = True

    def begin(self, delivery: Delivery) -> bool:
        """Before a frame from a stream is looked at; False: not now, it comes with a later `turn`, or to another one."""
        held = self._paths.get(delivery.path)
        if held is None:
            shard = self._receiver.shard_of(delivery)
            held = self._paths[delivery.path] = _HeldPath(shard, self._owner.grant(shard))
        if held.loaded:
            return True
        held.waiting.append(delivery)
        return False

    def end(self, delivery: Delivery) -> None:
        """After the callbacks of a frame from a stream."""
        if self._state is None:
            self._receiver.acknowledge(delivery)
            return
        held = self._paths[delivery.path]
        held.unsaved.append(delivery)
        held.unsaved_bytes += len(delivery.payload)
        if held.unsaved_bytes > _MOST_UNSAVED:
            held.due = 0.0

    def turn(self) -> list[Delivery]:
        """Between two rounds: load, save, and hand over; returns frames that need wait no longer, in order."""
        review, self._review = self._review, False
        now = time.monotonic()
        ready: list[Delivery] = []
        for path, held in list(self._paths.items()):
            if not held.loaded and now >= held.due:
                ready += self._take_up(path, held)
            elif held.loaded and (review or (held.unsaved and now >= held.due)):
                self._look(path, held, now)
        return ready

    def next_turn(self) -> float:
        """Seconds until `turn` has something to do."""
        if self._review:
            return 0.0
        due = [held.due for held in self._paths.values() if held.unsaved or held.waiting]
        return max(0.0, min(due, default=float("inf")) - time.monotonic())

    def close(self) -> None:
        """Save everything that is this instance's."""
        for path, held in list(self._paths.items()):
            if held.loaded and self._owner.standing(held.shard, held.grant) in (
                Standing.MINE,
                Standing.LEAVING,
            ):
                self._save(path, held)

    def _take_up(self, path: str, held: _HeldPath) -> list[Delivery]:
        """Load the state of a path; returns the frames that waited for it."""
        held.due = time.monotonic() + _RETRY_SECONDS
        standing = self._owner.standing(held.shard, held.grant)
        if standing is Standing.LOST:
            self._lose(path, held)
        if standing not in (Standing.MINE, Standing.LEAVING) or not self._loaded(path, held):
            return []
        held.loaded, held.due = True, time.monotonic() + self._every
        self._review = self._review or standing is Standing.LEAVING
        ready, held.waiting = held.waiting, []
        return ready

    def _loaded(self, path: str, held: _HeldPath) -> bool:
        if self._state is None:
            return True
        try:
            place = self._state.load(path)
        except BackendError as error:
            self._failed("loaded", path, error)
            return False
        self.counts["shard_loads"] += 1
        saved = _SavedPlace(0, [])
        try:
            saved = _parsed(place) if place is not None else saved
        except DecodeError as error:
            log.error("the place of %s cannot be read, repeated frames count twice: %s", path, error)  # noqa: TRY400
        held.number = max(held.grant, saved.number + 1)
        self._tracker.resume(path, {(instance, key): count for instance, key, count in saved.next})
        return True

    def _look(self, path: str, held: _HeldPath, now: float) -> None:
        standing = self._owner.standing(held.shard, held.grant)
        if standing is Standing.LOST:
            self._lose(path, held)
        elif standing is Standing.ASKING:
            held.due = now + _RETRY_SECONDS
        elif standing is Standing.LEAVING:
            if self._save(path, held):
                self._drop(path)
        else:
            held.grant = held.grant or self._owner.grant(held.shard)
            if now >= held.due:
                self._save(path, held)

    def _save(self, path: str, held: _HeldPath) -> bool:
        """Whether nothing is left to be saved."""
        held.due = time.monotonic() + self._every
        if self._state is None or not held.unsaved:
            return True
        try:
            self._state.save(path, _as_value(held.number, self._tracker.place(path)))
        except (BackendError, Superseded) as error:
            held.due = time.monotonic() + _RETRY_SECONDS
            self._failed("saved", path, error)
            return False
        if self._owner.standing(held.shard, held.grant) not in (Standing.MINE, Standing.LEAVING):
            return False  # suspended meanwhile: the next look tells
        self.counts["shard_saves"] += 1
        for delivery in held.unsaved:
            self._receiver.acknowledge(delivery)
        held.unsaved, held.unsaved_bytes = [], 0
        return True

    def _lose(self, path: str, held: _HeldPath) -> None:
        """Another instance may work on it already."""
        self.counts["shards_lost"] += 1
        log.warning("%s went to another instance while this one was suspended", path)
        self._drop(path)
        if not any(one.shard == held.shard for one in self._paths.values()):
            self._receiver.abandon(held.shard)
            self._owner.let_go(held.shard)

    def _drop(self, path: str) -> None:
        held = self._paths.pop(path)
        # when the path comes back, neither a gap nor a repeat follows from what was seen before
        self._tracker.leave(path)
        if self._state is not None and held.loaded:
            self._state.drop(path)

    def _failed(self, what: str, path: str, error: Exception) -> None:
        self.counts["shard_failures"] += 1
        if self.counts["shard_failures"] == 1:
            log.warning("the state of %s could not be %s: %s; trying again", path, what, error)


class _SavedPlace(msgspec.Struct, frozen=True):
    number: int
    next: list[tuple[str, str, int]]


def _as_value(number: int, numbers: dict[tuple[str, str], int]) -> Place:
    return {"number": number, "next": [[*name, count] for name, count in numbers.items()]}


def _parsed(place: object) -> _SavedPlace:
    """A place as it was saved; raises `DecodeError`."""
    try:
        saved = msgspec.convert(place, _SavedPlace)
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise DecodeError(f"no place of a shard: {error}") from None
    if len(saved.next) > _MOST_KEYS:
        raise DecodeError(f"a place of {len(saved.next)} keys: at most {_MOST_KEYS}")
    if not (0 <= saved.number < 1 << 62 and all(0 <= count < 1 << 62 for _, _, count in saved.next)):
        raise DecodeError("a place of a shard has numbers out of range")
    return saved


def grant_of(place: object) -> int:
    """The number of the grant by which a saved state was made.

    Args:
        place: as it was saved.

    Returns:
        The number; -1 for what is no place.
    """
    try:
        return _parsed(place).number
    except DecodeError:
        return -1
