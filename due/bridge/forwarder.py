"""One direction of a bridge: frames that one site wants of the other, sent as they came.

    receive ──► may it cross? ──► append, publish ──► settle ──► acknowledge     forwarding thread
    renew leases, drain                                                          source thread
                                  resend after an outage                         target thread

A reliable frame is acknowledged once the other site's server has it, so it survives the death of the bridge; a full
window there, or a cut link, stops the receiving, and with it the producers of this site.  Best-effort frames that
find no connection are lost and counted.  A frame that the other site refuses is set aside at this one: it would be
refused again.
"""

import logging
import threading
import time
from collections.abc import Iterable
from typing import Final

from due.bridge.bridged_keys import BridgedKeys
from due.drivers.base import Delivery, Publisher, Receiver
from due.errors import BackendError, DueError, Timeout, UpdatesUnavailable
from due.logs import LogLimit
from due.threads import Failed, LoudThread

log = logging.getLogger("due.bridge")

_REST_S: Final = 1.0
_UPKEEP_S: Final = 0.5
_SETTLE_S: Final = 1.0
_LINGER_S: Final = 0.005
_MOST_LINGER_S: Final = 1.0
_BATCH_BYTES: Final = 4 << 20
"""Reliable bytes on the way to the other site before their arrival is awaited: a slow link runs dry meanwhile."""
_BATCH_FRAMES: Final = 4_096
_END_S: Final = 5.0


class FrameForwarder:
    """Forwards from a receiver of one site to a publisher of the other; both are closed with it.

    Args:
        name: for logs, such as "to the far site".
        keys: what may cross.
        source: of the site where frames come from.
        target: of the site where they go to.
        failed: called by a thread that dies.
    """

    def __init__(
        self, name: str, keys: BridgedKeys, source: Receiver, target: Publisher, failed: Failed
    ) -> None:
        self.keys = keys
        self._name = name
        self._source, self._target = source, target
        self._lock = threading.Lock()
        self._active = False
        source.activate(False)
        self._busy = False
        """The forwarding thread does not read the source."""
        self._closing = threading.Event()
        self._errors = LogLimit(log)
        self._counts = dict.fromkeys(("frames", "bytes", "lost", "refused"), 0)
        self._unsettled: list[Delivery] = []
        self._unsettled_bytes = 0
        self._linger = _LINGER_S
        """How long more is awaited before the arrival of what was sent is, s: as long as that took the last time."""
        self._threads = (
            LoudThread("bridge-forward", self._forward, failed),
            LoudThread("bridge-source", self._keep_source, failed),
            LoudThread("bridge-target", self._keep_target, failed),
        )

    def start(self) -> None:
        """Begin to forward what is wanted."""
        for thread in self._threads:
            thread.start()

    def want(self, keys: Iterable[str]) -> tuple[str, ...]:
        """Replace what the other site wants; returns the patterns that are received for it."""
        with self._lock:
            before = self.keys.patterns
            self.keys.want(keys)
            patterns = self.keys.patterns
        for pattern in sorted(patterns - before):
            self._source.follow(pattern)
            self._source.subscribe(pattern)
        for pattern in sorted(before - patterns):
            self._source.unsubscribe(pattern)
            self._source.unfollow(pattern)
        return tuple(sorted(patterns))

    def activate(self, active: bool) -> None:
        """A standby, as which it begins, forwards nothing."""
        if active != self._active:
            self._active = active
            self._source.activate(active)

    def health(self) -> dict[str, int]:
        """Counters: frames and bytes that crossed, best-effort frames lost, frames that may not cross, or were refused."""
        return {**self._counts, "patterns": len(self.keys.patterns), "unsettled": len(self._unsettled)}

    def close(self) -> None:
        """Forward what was received, as far as the other site takes it at once, and end."""
        self._closing.set()
        self._source.wake()
        if self._threads[0].is_alive():
            self._threads[0].join(_END_S)
        self._target.close()  # wakes a thread that waits for room
        for thread in self._threads:
            if thread.is_alive():
                thread.join(_END_S)
        self._source.close()

    def _forward(self) -> None:
        while not self._closing.is_set():
            self._busy = False
            try:
                deliveries = self._source.receive(self._linger if self._unsettled else _REST_S)
            except DueError as error:
                self._errors.error("%s: receiving failed", self._name, error=error)
                self._closing.wait(0.1)
                continue
            self._busy = True
            try:
                for delivery in deliveries:
                    self._take(delivery)
            except UpdatesUnavailable:
                return  # closed while it waited for room: what is not acknowledged comes again
            if not deliveries or self._is_batch():
                self._settle()
        self._settle()

    def _take(self, delivery: Delivery) -> None:
        path, payload = delivery.path, delivery.payload
        if not (delivery.token or self._active):
            return  # the active instance forwards it
        if not self.keys.may_cross(path):
            self._counts["refused"] += 1
            if delivery.token:
                self._source.acknowledge(delivery)  # withdrawn a moment ago
            return
        try:
            if delivery.token:
                self._target.append(path, payload)
            else:
                self._target.publish(path, payload)
        except (UpdatesUnavailable, Timeout):
            if delivery.token:
                raise
            self._counts["lost"] += 1
            return
        except BackendError as error:
            if delivery.token and _may_pass(error):
                raise  # the frame comes again
            self._refuse(delivery, error)
            return
        if delivery.token:
            self._unsettled.append(delivery)
            self._unsettled_bytes += len(payload)
        self._counts["frames"] += 1
        self._counts["bytes"] += len(payload)

    def _refuse(self, delivery: Delivery, error: BackendError) -> None:
        """The other site will never take this frame; those behind it must not wait for it."""
        self._counts["refused"] += 1
        self._errors.error("%s: a frame of %s is refused there: %s", self._name, delivery.path, error)
        if delivery.token:
            self._source.set_aside(delivery, delivery.payload, f"{self._name}: {error}")
            self._source.acknowledge(delivery)

    def _is_batch(self) -> bool:
        return self._unsettled_bytes >= _BATCH_BYTES or len(self._unsettled) >= _BATCH_FRAMES

    def _settle(self) -> None:
        """Acknowledge here what has arrived there; while the link is cut, wait."""
        while self._unsettled:
            began = time.monotonic()
            try:
                self._target.settle(_SETTLE_S)
            except (
                Timeout,
                UpdatesUnavailable,
            ):  # the driver has said so, and sends again what did not arrive
                if self._closing.is_set():
                    return
                continue
            self._linger = min(max(_LINGER_S, time.monotonic() - began), _MOST_LINGER_S)
            for delivery in self._unsettled:
                self._source.acknowledge(delivery)
            self._unsettled, self._unsettled_bytes = [], 0

    def _keep_source(self) -> None:
        # not in one thread with the target, which waits while a link that was cut takes nothing: without leases the
        # producers of this site would wait for us no longer, and lose what we have not read
        while not self._closing.wait(_UPKEEP_S):
            self._source.renew()
            if self._busy:  # otherwise what is drained would wait until the next message comes
                self._source.drain()

    def _keep_target(self) -> None:
        while not self._closing.wait(_UPKEEP_S):
            try:
                self._target.poll()
            except DueError as error:
                self._errors.error("%s: upkeep failed", self._name, error=error)


def _may_pass(error: BackendError) -> bool:
    """Whether Kafka says so of a topic that it cannot make while a broker is away."""
    return "eplication factor" in str(error)
