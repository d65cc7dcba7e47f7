"""What `observe` returns, and what happens to a frame on its way to callbacks.

    Delivery ──decode──► fence ──► repeat? gap? ──► observations that match the key ──► callbacks

A callback that raises is reported with its key and does not stop the others.  Here, no I/O.
"""

import logging
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Any

from reactivex import abc
from reactivex.disposable import Disposable
from reactivex.subject import Subject

from due.codec import Frame
from due.keys import Key
from due.membership import most
from due.messages import Frequency, Item

log = logging.getLogger("due")

Callback = Callable[[Item], Any]
Failed = Callable[[Callback, Item, Exception], None]


class Observation(Subject[Item]):
    """A ReactiveX Subject of the items under a key.

    `subscribe(callback)` begins to receive; disposing the last subscription, or the Subject, withdraws
    the interest.  A callback given to `subscribe` directly survives its own exceptions; behind
    operators ReactiveX ends the subscription at the first one.
    """

    def __init__(
        self,
        key: Key,
        frequency: Frequency,
        start: str,
        opened: Callable[["Observation"], None],
        closed: Callable[["Observation"], None],
    ) -> None:
        super().__init__()
        self.key = key
        self.frequency = frequency
        self.start = start
        self.callbacks: tuple[Callback, ...] = ()
        limit = most(frequency) if isinstance(frequency, tuple) else None
        self._period = int(1e9 / limit) if limit else 0
        self._next = 0
        self._opened = opened
        self._closed = closed

    def subscribe(
        self,
        on_next: Any = None,
        on_error: Any = None,
        on_completed: Any = None,
        *,
        scheduler: abc.SchedulerBase | None = None,
    ) -> abc.DisposableBase:
        """As in ReactiveX; `on_next` is called in the engine's dispatcher thread, one call at a time."""
        self.check_disposed()
        if callable(on_next) and on_error is None and on_completed is None:
            callback: Callback = on_next
            inner: abc.DisposableBase = Disposable()
        else:
            tap: Subject[Item] = Subject()
            inner = tap.subscribe(on_next, on_error, on_completed, scheduler=scheduler)
            callback = tap.on_next
        first = not self.callbacks
        self.callbacks = (*self.callbacks, callback)
        if first:
            self._opened(self)
        return Disposable(lambda: self._remove(callback, inner))

    def on_next(self, value: Item) -> None:
        """Hand an item to all callbacks."""
        for callback in self.callbacks:
            callback(value)

    def dispose(self) -> None:
        """Withdraw the interest."""
        if self.callbacks:
            self.callbacks = ()
            self._closed(self)
        super().dispose()

    def thinned(self, items: Iterable[Item]) -> Iterable[Item]:
        """The items that stay under the interest's own maximum rate."""
        if not self._period:
            return items
        kept = []
        for item in items:
            if item.timestamp >= self._next:
                self._next = item.timestamp + self._period
                kept.append(item)
        return kept

    def _remove(self, callback: Callback, inner: abc.DisposableBase) -> None:
        inner.dispose()
        if callback in self.callbacks:
            rest = list(self.callbacks)
            rest.remove(callback)
            self.callbacks = tuple(rest)
            if not rest:
                self._closed(self)


class Tracker:
    """Per (instance, key): have we seen this frame, and is something missing before it?"""

    def __init__(self, *, shared: bool, remember: int = 65536) -> None:
        self._shared = shared
        self._remember = remember
        self._expected: OrderedDict[tuple[str, str], int] = OrderedDict()
        self._seen: OrderedDict[tuple[str, str, int], None] = OrderedDict()
        self._epochs: dict[tuple[str, str], int] = {}
        self.gaps = 0
        """Items known to be missing."""
        self.repeats = 0
        """Items that came again and were dropped."""
        self.fenced = 0
        """Items of an instance that is no longer the active one."""

    def admit(self, frame: Frame, *, reliable: bool) -> bool:
        """Whether to deliver it; counts gaps, repeats and items of an older epoch."""
        count = len(frame.timestamps)
        if frame.epoch and not self._current(frame):
            self.fenced += count
            return False
        if reliable and self._shared:
            return self._unseen(frame, count)
        name = (frame.instance_id, frame.key)
        expected = self._expected.get(name)
        if expected is None:
            self._make_space(self._expected)
        elif frame.before < expected:
            self.repeats += count
            return False
        elif frame.before > expected:
            self.gaps += frame.before - expected
            if not self.gaps - (frame.before - expected):
                log.warning("%d items of %s are missing; more are counted only", self.gaps, frame.key)
        self._expected[name] = frame.before + count
        return True

    def forget(self, keep: Callable[[str], bool]) -> None:
        """Forget keys that nobody observes any more: what is missed meanwhile is no gap."""
        for name in [n for n in self._expected if not keep(n[1])]:
            del self._expected[name]

    def _current(self, frame: Frame) -> bool:
        path = (frame.app_id, frame.key.partition(":")[0])
        if frame.epoch < self._epochs.get(path, 0):
            return False
        self._epochs[path] = frame.epoch
        return True

    def _unseen(self, frame: Frame, count: int) -> bool:
        name = (frame.instance_id, frame.key, frame.before)
        if name in self._seen:
            self.repeats += count
            return False
        self._make_space(self._seen)
        self._seen[name] = None
        return True

    def _make_space(self, table: OrderedDict[Any, Any]) -> None:
        if len(table) >= self._remember:
            table.popitem(last=False)


def deliver(items: Iterable[Item], callbacks: tuple[Callback, ...], failed: Failed) -> None:
    """Call every callback with every item."""
    if len(callbacks) == 1:
        only = callbacks[0]
        for item in items:
            try:
                only(item)
            except Exception as error:  # noqa: BLE001 - whatever a callback raises is reported, not ours to die of
                failed(only, item, error)
        return
    for item in items:
        for callback in callbacks:
            try:
                callback(item)
            except Exception as error:  # noqa: BLE001 - as above
                failed(callback, item, error)
