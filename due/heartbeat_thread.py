"""The thread for membership: heartbeats, assignments, leases, reconnects.  It never waits for data.

An active standby instance may write for `pause` seconds after a heartbeat that Data Updates have answered for; a
Coordinator waits longer before it replaces the instance.  Where that time ends, because the process was suspended or
its connection is away, the instance asks before it writes on, so that two never write at once.
"""

import logging
import threading
import time
from collections.abc import Callable

import msgspec

from due.clock import awake_ns
from due.codec import decode_frame
from due.dispatcher import Dispatcher
from due.drivers.base import Delivery, Publisher, Receiver
from due.errors import DueError, RefusedFrame
from due.logs import LogLimit
from due.membership import (
    ASSIGNMENT,
    HEARTBEAT,
    MOST_SHARDS,
    REGISTRATION,
    Assignments,
    Heartbeat,
    Member,
    Phase,
    Registration,
    Standing,
)
from due.threads import Failed, LoudThread

log = logging.getLogger("due")

_TICK = 0.1
"""Seconds between checks for a slow callback, while best-effort payloads arrive."""
_SLOW_TICK = 0.01
"""Seconds between two drains of the server while a callback is slow and payloads are found."""
_LATE = 0.01
"""A wake-up delayed by more than this means that the CPU cores are overloaded."""
_EASING = 0.8
_RENEW_SECONDS = 1.0
_ANSWER_SECONDS = 0.01
"""An answer to a heartbeat is looked for after this time."""
_SLOW_CALLBACK = 0.02

Say = Callable[[str, object], None]


class Rhythm:
    """Sleep times of the heartbeat thread; each of its wake-ups interrupts a busy app several times."""

    def __init__(self, longest: float) -> None:
        self._longest = longest
        self._tick = _TICK
        self._slow_tick = _SLOW_TICK

    def rest(self, *, coming: bool, slow: bool) -> float:
        """Seconds to sleep; `coming`: best-effort payloads arrived meanwhile; `slow`: a callback is slow."""
        wanted = self._slow_tick if slow else self._tick if coming else self._longest
        return min(wanted, self._longest)

    def got_up(self, *, late: bool) -> None:
        """Note a wake-up; if it was late, check less often and leave the CPU to the callbacks."""
        self._tick = (
            min(2 * self._tick, max(_TICK, self._longest)) if late else max(_TICK, _EASING * self._tick)
        )

    def drained(self, *, some: bool) -> None:
        """Note a drain; if it found nothing, the next one may come later."""
        self._slow_tick = _SLOW_TICK if some else min(2 * self._slow_tick, _TICK)


class HeartbeatThread:
    """Drives a `Member`: timers, messages and leases."""

    def __init__(
        self,
        member: Member,
        control: Receiver,
        publisher: Publisher,
        dispatcher: Dispatcher,
        *,
        pause: float,
        failed: Failed | None = None,
    ) -> None:
        self.member = member
        self.lock = threading.Lock()
        """Guards `member`."""
        self.alive_until = 0
        """A write after this time (`awake_ns`) comes from a process that was suspended or cut off meanwhile."""
        self.superseded = 0
        """How often another instance took this one's place while this one was active or asked whether it is."""
        self.turned = time.monotonic()
        """Start of the last loop iteration, monotonic seconds."""
        self.say: Say = lambda _path, _value: None
        """How to write a membership message; set by the engine."""
        self.changed: Callable[[], None] = lambda: None
        """Called when permissions may have changed; set by the engine."""
        self.written: Callable[[], int] = lambda: 0
        self._control = control
        self._publisher = publisher
        self._dispatcher = dispatcher
        self._pause = pause
        self.misunderstood = 0
        """Assignments that were refused."""
        self._probed = 0
        self._unanswered = False
        self._seen = -1
        self._renew_at = 0.0
        self._poll_again = 0.0
        self._rhythm = Rhythm(pause / 3)
        self._heard = 0
        self._errors = LogLimit(log)
        self._closed = False
        self._thread = LoudThread("due-heartbeat", self._run, failed)

    def start(self) -> None:
        """Register and begin."""
        self.alive_until = awake_ns() + int(self._pause * 1e9)
        me = self.member.registration
        self._control.subscribe(f"{ASSIGNMENT}.{me.app_id}")
        if me.instances != "shared" and self.member.announced:
            self._control.subscribe(f"{HEARTBEAT}.{me.app_id}")
        self._turn()
        self._thread.start()

    def wake(self) -> None:
        """Run the next iteration now."""
        self._control.wake()

    @property
    def connected(self) -> bool:
        """Whether Data Updates have answered lately and can tell this instance of assignments."""
        return self._control.connected and awake_ns() <= self._publisher.answered + int(self._pause * 1e9)

    def check_pause(self) -> None:
        """Check for a suspension or a lost connection; called by writers after `alive_until` and by this thread."""
        with self.lock:
            now = awake_ns()
            if now <= self.alive_until:
                return
            late = (now - self.alive_until) / 1e9 + self._pause
            self.alive_until = now + int(self._pause * 1e9)
            if self.member.paused(time.monotonic()):
                log.warning(
                    "suspended or without Data Updates for %.1f s: asking which instance is active before writing more",
                    late,
                )
        self.changed()

    def standing(self, shard: str, grant: int) -> Standing:
        """See `Member.standing`; a suspension until this moment counts."""
        self.check_pause()
        with self.lock:
            return self.member.standing(shard, grant)

    def named_here(self) -> frozenset[str] | None:
        """See `Member.named_here`; a suspension until this moment counts."""
        self.check_pause()
        with self.lock:
            return self.member.named_here

    def offer(self, names: tuple[str, ...]) -> None:
        """See `Member.offer`."""
        with self.lock:
            self.member.offer(names, time.monotonic())

    def grant(self, shard: str) -> int:
        """See `Member.grant`."""
        with self.lock:
            return self.member.grant(shard)

    def let_go(self, shard: str) -> None:
        """See `Member.let_go`."""
        with self.lock:
            self.member.let_go(shard)

    def close(self) -> None:
        """Send the offline heartbeat and stop."""
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
                self._look_at_connection()
                self.check_pause()
                self._turn()
                self.turned = time.monotonic()
            except DueError as error:
                self._errors.error("membership", error=error)
                time.sleep(_TICK)

    def _look_at_connection(self) -> None:
        """Renew the right to write, if Data Updates answer."""
        self._poll_again = self._publisher.poll()
        works = self.connected
        if works:
            self.alive_until = max(self.alive_until, self._publisher.answered + int(self._pause * 1e9))
        with self.lock:
            self.member.connection(time.monotonic(), works=works)

    def _listen(self) -> None:
        busy = self._dispatcher.busy_since
        began = time.monotonic()
        slow = busy is not None and began - busy > _SLOW_CALLBACK
        heard, self._heard = self._heard, self._dispatcher.best_effort
        rest = min(self._rhythm.rest(coming=self._heard != heard, slow=slow), self._poll_again)
        if self._unanswered:
            self._unanswered, rest = False, min(rest, _ANSWER_SECONDS)
        wait = min(rest, max(0.0, self.member.next_tick() - began))
        deliveries = self._control.receive(wait)
        self._rhythm.got_up(late=time.monotonic() - began - wait > _LATE)
        for delivery in deliveries:
            try:
                self._understand(delivery)
            except (DueError, msgspec.ValidationError) as error:
                self.misunderstood += 1
                if self.misunderstood == 1:
                    log.warning(
                        "an assignment or heartbeat was refused: %s; further ones are only counted", error
                    )

    def _understand(self, delivery: Delivery) -> None:
        """Raises `DueError` or `msgspec.ValidationError` for what is none of our messages."""
        frame = decode_frame(delivery.payload)
        if frame.key != delivery.path:
            raise RefusedFrame("misplaced", f"a frame of {frame.key} arrived under {delivery.path}")
        if delivery.path.startswith(HEARTBEAT):
            beat = Heartbeat.from_value(frame.values[-1])
            if {frame.app_id, beat.app_id} != {self.member.registration.app_id}:
                raise RefusedFrame(
                    "foreign", f"a heartbeat under {delivery.path} is from {frame.app_id[:64]!r}"
                )
            with self.lock:
                self.member.heard(beat, time.monotonic())
            return
        message = Assignments.from_value(frame.values[-1])
        with self.lock:
            worked = self.member.active or self.member.asking
            self.member.assigned(message, time.monotonic())
            self.superseded += worked and not self.member.active

    def _turn(self) -> None:
        now = time.monotonic()
        with self.lock:
            worked = self.member.active
            messages = self.member.tick(now, self._beat)
            changes, active, reading = self.member.changes, self.member.active, self.member.reading
            shards = self.member.shards
            self.superseded += worked and not active
        probed = awake_ns()
        for message in messages:
            self._send(message)
        if messages or probed - self._probed > self.member.registration.heartbeat * 1e9:
            self._probed, self._unanswered = probed, True
            self._publisher.probe(probed)
        if changes != self._seen:
            # the other instances of a sharded app go on working
            alone = self.member.registration.instances != "sharded"
            take_over = alone and self.member.phase is Phase.COORDINATED
            self._seen = changes
            self._dispatcher.share(shards)
            self._dispatcher.activate(active, reading=reading, take_over=take_over)
            self.changed()
        if now >= self._renew_at:
            self._renew_at = now + _RENEW_SECONDS
            self._dispatcher.receiver.renew()
        busy = self._dispatcher.busy_since
        if busy is not None and now - busy > _SLOW_CALLBACK:
            self._rhythm.drained(some=self._dispatcher.receiver.drain())

    def _beat(self) -> Heartbeat:
        """A heartbeat with what this instance has done, and with its shards."""
        member, receiver = self.member, self._dispatcher.receiver
        offered: tuple[str, ...] = ()
        held: tuple[str, ...] = ()
        if member.named:
            offered, held = member.offered, member.named_held
        elif member.registration.instances == "sharded":
            offered, held = receiver.offered()[:MOST_SHARDS], receiver.held()[:MOST_SHARDS]
        return member.beat(
            written=self.written(), received=self._dispatcher.received, offered=offered, held=held
        )

    def _send(self, message: Registration | Heartbeat) -> None:
        path = REGISTRATION if isinstance(message, Registration) else HEARTBEAT
        try:
            self.say(f"{path}.{message.app_id}", message.to_value())
        except DueError as error:
            log.debug("%s could not be sent: %s", path, error)
