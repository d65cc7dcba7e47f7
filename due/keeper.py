"""The thread that keeps the membership: heartbeats, assignments, leases, reconnects.  It never waits for data."""

import logging
import threading
import time
from collections.abc import Callable

import msgspec

from due.codec import decode_frame
from due.dispatcher import Dispatcher
from due.drivers.base import Publisher, Receiver
from due.errors import DueError
from due.membership import (
    ASSIGNMENT,
    HEARTBEAT,
    REGISTRATION,
    Assignments,
    Heartbeat,
    Member,
    Phase,
    Registration,
)

log = logging.getLogger("due")

_TICK = 0.1
"""How often to look whether a callback takes long, while best-effort payloads come."""
_SLOW_TICK = 0.01
"""How often to take them off the server while one does, and some are found."""
_LATE = 0.01
"""Who wakes up later than this has to wait for a core."""
_EASING = 0.8
_RENEW_SECONDS = 1.0
_SLOW_CALLBACK = 0.02

Say = Callable[[str, object], None]


class Rhythm:
    """How long the keeper may rest, seconds; each time it gets up costs an app that computes several wake-ups."""

    def __init__(self, longest: float) -> None:
        self._longest = longest
        self._tick = _TICK
        self._slow_tick = _SLOW_TICK

    def rest(self, *, coming: bool, slow: bool) -> float:
        """`coming`: best-effort payloads came since the last time; `slow`: a callback takes long."""
        wanted = self._slow_tick if slow else self._tick if coming else self._longest
        return min(wanted, self._longest)

    def got_up(self, *, late: bool) -> None:
        """Where cores are short, look at the callbacks more rarely: they need them more."""
        self._tick = (
            min(2 * self._tick, max(_TICK, self._longest)) if late else max(_TICK, _EASING * self._tick)
        )

    def drained(self, *, some: bool) -> None:
        """Where nothing was found on the server, there is no hurry to look again."""
        self._slow_tick = _SLOW_TICK if some else min(2 * self._slow_tick, _TICK)


class Keeper:
    """Connects a `Member` with the world."""

    def __init__(
        self, member: Member, control: Receiver, publisher: Publisher, dispatcher: Dispatcher, *, pause: float
    ) -> None:
        self.member = member
        self.lock = threading.Lock()
        """Guards `member`."""
        self.alive_until = 0
        """Writes after this time (UTC, ns) come from a process that was stopped meanwhile."""
        self.say: Say = lambda _path, _value: None
        """How to write a membership message; set by the engine."""
        self.changed: Callable[[], None] = lambda: None
        """Called when permissions may have changed; set by the engine."""
        self.written: Callable[[], int] = lambda: 0
        self._control = control
        self._publisher = publisher
        self._dispatcher = dispatcher
        self._pause = pause
        self._seen = -1
        self._renew_at = 0.0
        self._poll_again = 0.0
        self._rhythm = Rhythm(pause / 3)
        self._heard = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="due-keeper", daemon=True)

    def start(self) -> None:
        """Register and begin."""
        self.alive_until = time.time_ns() + int(self._pause * 1e9)
        self._control.subscribe(f"{ASSIGNMENT}.{self.member.registration.app_id}")
        self._turn()
        self._thread.start()

    def wake(self) -> None:
        """Look at the member now."""
        self._control.wake()

    def check_pause(self) -> None:
        """Called by a writer that comes after `alive_until`, and by ourselves."""
        with self.lock:
            now = time.time_ns()
            if now <= self.alive_until:
                return
            late = (now - self.alive_until) / 1e9 + self._pause
            self.alive_until = now + int(self._pause * 1e9)
            if self.member.paused(time.monotonic()):
                log.warning("stopped for %.1f s: asking who is active before writing on", late)
        self.changed()

    def close(self) -> None:
        """Say goodbye and stop."""
        self._closed = True
        self._control.wake()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(5)
        with self.lock:
            goodbye = self.member.beat("offline")
        if self.member.announced:
            self._send(goodbye)
        self._control.close()

    def _run(self) -> None:
        while not self._closed:
            try:
                self._listen()
                self.check_pause()
                self.alive_until = time.time_ns() + int(self._pause * 1e9)
                self._turn()
            except DueError:
                log.exception("membership")
                time.sleep(_TICK)

    def _listen(self) -> None:
        busy = self._dispatcher.busy_since
        began = time.monotonic()
        slow = busy is not None and began - busy > _SLOW_CALLBACK
        heard, self._heard = self._heard, self._dispatcher.best_effort
        rest = min(self._rhythm.rest(coming=self._heard != heard, slow=slow), self._poll_again)
        wait = min(rest, max(0.0, self.member.next_tick() - began))
        deliveries = self._control.receive(wait)
        self._rhythm.got_up(late=time.monotonic() - began - wait > _LATE)
        for delivery in deliveries:
            try:
                message = Assignments.from_value(decode_frame(delivery.payload).values[-1])
            except (DueError, msgspec.ValidationError, IndexError) as error:
                log.warning("an assignment was not understood: %s", error)
                continue
            with self.lock:
                self.member.assigned(message, time.monotonic())

    def _turn(self) -> None:
        now = time.monotonic()
        with self.lock:
            messages = self.member.tick(now, written=self.written(), received=self._dispatcher.received)
            changes, active, reading = self.member.changes, self.member.active, self.member.reading
        for message in messages:
            self._send(message)
        if changes != self._seen:
            take_over = self.member.phase is Phase.COORDINATED
            self._seen = changes
            self._dispatcher.activate(active, reading=reading, take_over=take_over)
            self.changed()
        self._poll_again = self._publisher.poll()
        if now >= self._renew_at:
            self._renew_at = now + _RENEW_SECONDS
            self._dispatcher.receiver.renew()
        busy = self._dispatcher.busy_since
        if busy is not None and now - busy > _SLOW_CALLBACK:
            self._rhythm.drained(some=self._dispatcher.receiver.drain())

    def _send(self, message: Registration | Heartbeat) -> None:
        path = REGISTRATION if isinstance(message, Registration) else HEARTBEAT
        try:
            self.say(f"{path}.{message.app_id}", message.to_value())
        except DueError as error:
            log.debug("%s could not be sent: %s", path, error)
