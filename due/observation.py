"""What `observe` returns, and how a frame reaches the callbacks.

    Delivery ──decode──► content matches channel? ──► Tracker ──► observations that match the key ──►
    callbacks

A callback that raises is reported with its key and does not stop the others.  No I/O.
"""

from collections.abc import Callable, Iterable
from typing import Any

from reactivex import abc
from reactivex.disposable import Disposable
from reactivex.subject import Subject

from due.keys import Key
from due.membership import most
from due.messages import Frequency, Item

Callback = Callable[[Item], Any]
Failed = Callable[[Callback, Item, Exception], None]


class Observation(Subject[Item]):
    """A ReactiveX Subject of the items under a key; made by `Engine.observe`.

    `subscribe(callback)` starts receiving; disposing the last subscription, or the Subject, withdraws the
    interest.  A callback passed to `subscribe` directly survives its own exceptions; behind operators,
    ReactiveX ends the subscription at the first exception.

    Args:
        key: the observed key.
        frequency: the wanted rate, Hz, or (minimum, maximum): items above the maximum are dropped here.
        start: stream id from which to replay a reliable key; empty for none.
        opened: called at the first subscription.
        closed: called when the last subscription is disposed.
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
        """Start receiving; as in ReactiveX, but calls come from the engine's dispatcher thread, one at a
        time.

        Args:
            on_next: called with each item.
            on_error, on_completed: as in ReactiveX; an Observation itself neither fails nor completes.
            scheduler: as in ReactiveX.

        Returns:
            The subscription; `dispose()` ends it.

        Raises:
            DisposedException: the Subject was disposed.
        """
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
        """Pass an item to all callbacks.

        Args:
            value: the item.
        """
        for callback in self.callbacks:
            callback(value)

    def dispose(self) -> None:
        """Withdraw the interest."""
        if self.callbacks:
            self.callbacks = ()
            self._closed(self)
        super().dispose()

    def thinned(self, items: Iterable[Item]) -> Iterable[Item]:
        """Limit items to the interest's own maximum rate.

        Args:
            items: items in the order received.

        Returns:
            Those that the rate leaves, judged by their `timestamp`.
        """
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


def deliver(items: Iterable[Item], callbacks: tuple[Callback, ...], failed: Failed) -> None:
    """Call every callback with every item."""
    if len(callbacks) == 1:
        only = callbacks[0]
        for item in items:
            try:
                only(item)
            except Exception as error:  # noqa: BLE001 - a callback may raise anything; it is reported
                failed(only, item, error)
        return
    for item in items:
        for callback in callbacks:
            try:
                callback(item)
            except Exception as error:  # noqa: BLE001 - as above
                failed(callback, item, error)
