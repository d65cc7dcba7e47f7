"""The thread in which callbacks run: it receives, decodes, and hands items to observations, one at a time."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence

from due.codec import Frame, decode_frame, encode_frame, freeze
from due.drivers.base import Delivery, Receiver
from due.errors import DecodeError, DueError, NewerVersion, RefusedFrame
from due.keys import Key
from due.logs import LogLimit
from due.messages import Item
from due.observation import Callback, Observation, deliver
from due.routes import Routes
from due.shards import ShardWork
from due.threads import Failed, LoudThread
from due.tracker import Tracker

log = logging.getLogger("due")

_REFUSALS = ("undecodable", "newer_version", "misplaced", "foreign", "out_of_range")
"""Causes for which frames are refused, as counted in `health`."""
_REFUSED_BYTES = 4096
"""Bytes of a refused frame that are kept for diagnosis."""
_REASON = 512
_REST = 30.0
"""Longest wait for data, seconds; `wake` ends it, and receivers with periodic work end it earlier."""


class Dispatcher:
    """Owns the receiver and the observations."""

    def __init__(self, receiver: Receiver, *, shared: bool, tries: int, failed: Failed | None = None) -> None:
        self.receiver = receiver
        self.tracker = Tracker(shared=shared)
        self.received = 0
        self.best_effort = 0
        """Best-effort payloads received."""
        self.busy_since: float | None = None
        """When the running callbacks were entered, monotonic seconds; None while waiting."""
        self.answered = 0.0
        """When the last answered question was asked, monotonic seconds."""
        self._asked = 0.0
        self._tries = tries
        self._routes = Routes()
        self._tasks: deque[Callable[[], None]] = deque()
        self._errors = LogLimit(log)
        self._closed = False
        self._halted = False
        self._active = True
        self._reading = True
        self._counts = dict.fromkeys((*_REFUSALS, "callback_errors", "set_aside"), 0)
        self._reliable: Delivery | None = None
        self.shards: ShardWork | None = None
        """Of a sharded app; set by the session."""
        self._thread = LoudThread("due-dispatcher", self._run, failed)

    def start(self) -> None:
        """Begin to receive."""
        self._thread.start()

    def post(self, task: Callable[[], None]) -> None:
        """Run a task in this thread, between callbacks."""
        self._tasks.append(task)
        self.receiver.wake()

    def ask(self) -> None:
        """Ask the thread to answer between two frames; has no effect while a question is open."""
        if self.answered == self._asked:
            self._asked = time.monotonic()
        self.receiver.wake()

    def unanswered(self) -> float:
        """Seconds for which the question of `ask` has been open; 0.0 once it is answered."""
        asked = self._asked
        return time.monotonic() - asked if self.answered != asked else 0.0

    def inside(self) -> bool:
        """Whether the caller is a callback."""
        return threading.current_thread() is self._thread

    def open(self, observation: Observation) -> None:
        """Begin to receive for it."""
        self._routes.change(lambda there: (*there, observation))
        self.receiver.follow(observation.key.path, start=observation.start)
        self.receiver.subscribe(observation.key.path)

    def shut(self, observation: Observation) -> None:
        """Stop receiving for it."""
        self._routes.change(lambda there: tuple(o for o in there if o is not observation))
        rest = self._routes.observations
        self.receiver.unsubscribe(observation.key.path)
        if observation.key.path not in {o.key.path for o in rest}:
            self.receiver.unfollow(observation.key.path)
        self.post(lambda: self.tracker.forget(lambda key: any(o.key.matches(Key(key)) for o in rest)))

    def activate(self, active: bool, *, reading: bool, take_over: bool) -> None:
        """A standby instance that is not active receives nothing."""
        self._active = active
        if reading != self._reading:
            self._reading = reading
            if reading:
                self.post(self.tracker.rested)
            self.receiver.activate(reading, take_over=take_over)

    def share(self, shards: frozenset[str] | None) -> None:
        """The shards of a sharded app that are this instance's."""
        if self.shards is not None:
            self.receiver.share(shards)
            self.shards.changed()
            self.receiver.wake()

    def statistics(self) -> dict[str, int]:
        """Counters for `health`."""
        sharded = self.shards.counts if self.shards is not None else {}
        tracked = {name: getattr(self.tracker, name) for name in ("gaps", "repeats", "fenced", "refuted")}
        return {"received": self.received, **tracked, **self._counts, **sharded, **self.receiver.statistics()}

    def halt(self) -> None:
        """Callbacks cannot work any more: stop, and leave undelivered items to the next process."""
        self._halted = self._closed = True
        self.receiver.wake()

    def finish(self) -> None:
        """Stop after the running callback; a sharded app saves its state."""
        self._closed = True
        self.receiver.wake()
        if not self.inside() and self._thread.is_alive():
            self._thread.join(10)

    def close(self) -> None:
        """Stop, and disconnect."""
        self.finish()
        self.receiver.close()

    def _run(self) -> None:
        while not self._closing():
            try:
                rest = _REST if self.shards is None else min(_REST, self.shards.next_turn())
                deliveries = self.receiver.receive(rest)
            except DueError as error:
                self._errors.error("receiving failed", error=error)
                time.sleep(0.1)
                continue
            self.busy_since = time.monotonic()
            self.answered = self._asked
            # first: a key that is forgotten here may be observed again by these tasks
            while self._tasks and not self._closing():
                self._run_task(self._tasks.popleft())
            self._dispatch_all(deliveries)
            if self.shards is not None and not self._closing():
                self._dispatch_all(self.shards.turn())
            self.busy_since = None
        if self.shards is not None and not self._halted:
            self.shards.close()

    def _dispatch_all(self, deliveries: Sequence[Delivery]) -> None:
        for delivery in deliveries:
            self._dispatch(delivery)
            self.answered = self._asked
            if self._closing():
                break

    def _closing(self) -> bool:
        return self._closed

    def _run_task(self, task: Callable[[], None]) -> None:
        try:
            task()
        except Exception as error:  # noqa: BLE001 - a callback may raise anything; it is reported
            self._counts["callback_errors"] += 1
            self._errors.error("a callback failed", error=error)

    def _dispatch(self, delivery: Delivery) -> None:
        if not self._begun(delivery):
            return
        try:
            frame = decode_frame(delivery.payload)
            route = self._routes.known.get(frame.key)
            if route is not None and route[0] == delivery.path and route[1] == frame.app_id:
                observations = route[2]
            else:
                observations = self._routes.find(frame.key, frame.app_id, delivery.path)
            new = bool(observations) and self.tracker.admit(frame, reliable=bool(delivery.token))
        except NewerVersion as error:
            # whole: this app can read it once it is upgraded, too
            self._refuse("newer_version", delivery, delivery.payload, error)
        except DecodeError as error:
            self._refuse("undecodable", delivery, delivery.payload[:_REFUSED_BYTES], error)
        except RefusedFrame as error:
            self._refuse(error.cause, delivery, delivery.payload[:_REFUSED_BYTES], error)
        else:
            if new:
                self._deliver(delivery, frame, observations)
        if not delivery.token or self._halted:
            return
        if self.shards is not None:
            self.shards.end(delivery)
        else:
            self.receiver.acknowledge(delivery)

    def _begun(self, delivery: Delivery) -> bool:
        """Whether to look at a delivery now."""
        if delivery.token:
            return self.shards is None or self.shards.begin(delivery)
        self.best_effort += 1
        return self._active

    def _deliver(self, delivery: Delivery, frame: Frame, observations: tuple[Observation, ...]) -> None:
        if delivery.tries > self._tries + 1:
            self._counts["set_aside"] += len(frame.values)
            log.error("a frame of %s killed %d consumers and is set aside", frame.key, delivery.tries - 1)
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
        """Report the failure; on reliable keys retry, and finally set the item aside."""
        self._counts["callback_errors"] += 1
        if self._halted:
            return
        tries = 1
        while self._reliable is not None and tries < self._tries:
            tries += 1
            try:
                callback(item)
            except Exception as again:  # noqa: BLE001 - as in `deliver`
                error = again
            else:
                return
        self._errors.error("a callback failed on %s (sequence %d)", item.key, item.sequence, error=error)
        if self._reliable is not None:
            self._counts["set_aside"] += 1
            reason = f"{type(error).__name__}: {error}"[:_REASON]
            self.receiver.set_aside(self._reliable, _alone(item), reason)

    def _refuse(self, cause: str, delivery: Delivery, kept: bytes, error: DueError) -> None:
        """Count the refusal; a frame from a stream is set aside, so that it is not read again."""
        self._counts[cause] += 1
        if self._counts[cause] == 1:
            log.error("refused a frame under %s: %s; further ones are only counted", delivery.path, error)
        if delivery.token:
            self.receiver.set_aside(delivery, kept, f"{cause}: {error}"[:_REASON])


def _alone(item: Item) -> bytes:
    times = [item.timestamp], [item.event_time], [freeze(item.value)]
    return encode_frame(Frame(item.key, item.app_id, item.instance_id, 0, item.sequence, 0, *times))
