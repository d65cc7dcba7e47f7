"""The thread in which callbacks run: it receives, decodes, and hands items to observations, one at a time."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

from due.codec import Frame, decode_frame, encode_frame, freeze
from due.drivers.base import Delivery, Receiver
from due.errors import DecodeError, DueError
from due.keys import Key
from due.messages import Item
from due.observation import Callback, Observation, Tracker, deliver

log = logging.getLogger("due")

_ROUTES = 65536
_REST = 30.0
"""Seconds without anything to receive; `wake` ends it, and receivers with something to look after do."""


class Dispatcher:
    """Owns the receiver and the observations."""

    def __init__(self, receiver: Receiver, *, shared: bool, tries: int) -> None:
        self.receiver = receiver
        self.tracker = Tracker(shared=shared)
        self.received = 0
        self.best_effort = 0
        """Payloads that came without being kept by the server."""
        self.busy_since: float | None = None
        """When the running callbacks were entered, monotonic seconds; None while waiting."""
        self._tries = tries
        self._observations: tuple[Observation, ...] = ()
        self._routes: dict[str, tuple[Observation, ...]] = {}
        self._tasks: deque[Callable[[], None]] = deque()
        self._lock = threading.Lock()
        self._closed = False
        self._active = True
        self._reading = True
        self._counts = {"undecodable": 0, "newer_version": 0, "callback_errors": 0, "set_aside": 0}
        self._reliable: Delivery | None = None
        self._thread = threading.Thread(target=self._run, name="due-dispatcher", daemon=True)

    def start(self) -> None:
        """Begin to receive."""
        self._thread.start()

    def post(self, task: Callable[[], None]) -> None:
        """Run a task in this thread, between callbacks."""
        self._tasks.append(task)
        self.receiver.wake()

    def inside(self) -> bool:
        """Whether the caller is a callback."""
        return threading.current_thread() is self._thread

    def open(self, observation: Observation) -> None:
        """Begin to receive for it."""
        with self._lock:
            self._observations = (*self._observations, observation)
            self._routes = {}
        self.receiver.follow(observation.key.path, start=observation.start)
        self.receiver.subscribe(observation.key.path)

    def shut(self, observation: Observation) -> None:
        """Stop receiving for it."""
        with self._lock:
            self._observations = tuple(o for o in self._observations if o is not observation)
            self._routes = {}
            rest = self._observations
        self.receiver.unsubscribe(observation.key.path)
        if observation.key.path not in {o.key.path for o in rest}:
            self.receiver.unfollow(observation.key.path)
        self.post(lambda: self.tracker.forget(lambda key: any(o.key.matches(Key(key)) for o in rest)))

    def activate(self, active: bool, *, reading: bool, take_over: bool) -> None:
        """A standby instance that is not active receives nothing."""
        self._active = active
        if reading != self._reading:
            self._reading = reading
            self.receiver.activate(reading, take_over=take_over)

    def statistics(self) -> dict[str, int]:
        """Counters for `health`."""
        tracked = {"gaps": self.tracker.gaps, "repeats": self.tracker.repeats, "fenced": self.tracker.fenced}
        return {"received": self.received, **tracked, **self._counts, **self.receiver.statistics()}

    def close(self) -> None:
        """Stop after the running callback."""
        self._closed = True
        self.receiver.wake()
        if not self.inside() and self._thread.is_alive():
            self._thread.join(10)
        self.receiver.close()

    def _run(self) -> None:
        while not self._closing():
            try:
                deliveries = self.receiver.receive(_REST)
            except DueError:
                log.exception("receiving failed")
                time.sleep(0.1)
                continue
            self.busy_since = time.monotonic()
            # first, for what is forgotten here may have begun anew with these
            while self._tasks and not self._closing():
                self._run_task(self._tasks.popleft())
            for delivery in deliveries:
                self._dispatch(delivery)
                if self._closing():
                    break
            self.busy_since = None

    def _closing(self) -> bool:
        return self._closed

    def _run_task(self, task: Callable[[], None]) -> None:
        try:
            task()
        except Exception:
            self._counts["callback_errors"] += 1
            log.exception("a callback failed")

    def _dispatch(self, delivery: Delivery) -> None:
        if not delivery.token:
            self.best_effort += 1
            if not self._active:
                return
        try:
            frame = decode_frame(delivery.payload)
        except DecodeError as error:
            self._undecodable(delivery, error)
        else:
            observations = self._routes.get(frame.key)
            if observations is None:
                observations = self._route(frame.key)
            if observations and self.tracker.admit(frame, reliable=bool(delivery.token)):
                self._deliver(delivery, frame, observations)
        if delivery.token:
            self.receiver.acknowledge(delivery)

    def _deliver(self, delivery: Delivery, frame: Frame, observations: tuple[Observation, ...]) -> None:
        if delivery.tries > self._tries + 1:
            self._counts["set_aside"] += len(frame.values)
            log.error("a frame of %s ended %d consumers: set aside", frame.key, delivery.tries - 1)
            self.receiver.set_aside(delivery, delivery.payload, "its consumers died")
            return
        self.received += len(frame.values)
        self._reliable = delivery if delivery.token else None
        if len(observations) == 1:
            only = observations[0]
            deliver(only.thinned(frame.stream()), only.callbacks, self._failed)
            return
        items = frame.items()
        for observation in observations:
            deliver(observation.thinned(items), observation.callbacks, self._failed)

    def _failed(self, callback: Callback, item: Item, error: Exception) -> None:
        """Report, try again on reliable keys, and set the item aside in the end."""
        self._counts["callback_errors"] += 1
        tries = 1
        while self._reliable is not None and tries < self._tries:
            tries += 1
            try:
                callback(item)
            except Exception as again:  # noqa: BLE001 - as in `deliver`
                error = again
            else:
                return
        log.error("a callback failed on %s (sequence %d)", item.key, item.sequence, exc_info=error)
        if self._reliable is not None:
            self._counts["set_aside"] += 1
            self.receiver.set_aside(self._reliable, _alone(item), f"{type(error).__name__}: {error}")

    def _undecodable(self, delivery: Delivery, error: DecodeError) -> None:
        kind = "newer_version" if type(error) is not DecodeError else "undecodable"
        self._counts[kind] += 1
        if self._counts[kind] == 1:
            log.error("skipped what arrived under %s: %s; more are counted only", delivery.path, error)

    def _route(self, text: str) -> tuple[Observation, ...]:
        """The observations that want this key; remembered until they change."""
        with self._lock:
            try:
                key = Key(text)
            except DueError:
                return ()
            found = tuple(o for o in self._observations if o.key.matches(key))
            if len(self._routes) >= _ROUTES:
                self._routes = {}
            self._routes[text] = found
            return found


def _alone(item: Item) -> bytes:
    times = [item.timestamp], [item.event_time], [freeze(item.value)]
    return encode_frame(Frame(item.key, item.app_id, item.instance_id, 0, item.sequence, 0, *times))
