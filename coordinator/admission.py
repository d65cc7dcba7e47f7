"""Which registrations, heartbeats and checkpoints the registry accepts.  Pure.

Messages are untrusted: implausible ones, and more than a Coordinator can hold, are refused, counted
and reported. Members check the same on their side; the limits are far above what a pipeline declares.
"""

import logging
import re
from collections import deque
from collections.abc import Iterator

import msgspec

from coordinator.registry import Checkpoint, Registry
from due.membership import Heartbeat, Registration

log = logging.getLogger("coordinator")

MOST_APPS = 1000
MOST_INSTANCES = 100
"""Instances of one app, including those that have ended but are still listed."""
MOST_KEYS = 5000
"""Capabilities and interests of all apps, because matching compares every pair."""
MOST_EPOCH = 2**53
EPOCH_STEP = 1 << 28
"""How far an epoch may be ahead of the known one: epochs begin at the seconds of a Coordinator's clock, which may
have been wrong by years (this is eight and a half)."""
_HEARTBEAT_S = (0.01, 3600.0)
_MOST_TEXT = 256
_MOST_SHARD_TEXT = 1 << 20
_APP = re.compile(r"[A-Za-z0-9_-]{1,128}")
_TOLD = 20


class Refusal(msgspec.Struct, frozen=True):
    """One refused message."""

    app_id: str
    instance_id: str
    reason: str


class Admission:
    """Guards one registry; `refused` counts the refusals, `last` lists the most recent."""

    def __init__(self, registry: Registry) -> None:
        self._registry = registry
        self.refused = 0
        self.last: deque[Refusal] = deque(maxlen=_TOLD)

    def registration(self, message: Registration, said_by: str) -> bool:
        """Whether to accept a registration; `said_by`: the app that wrote the item."""
        return self._judged(message, next(self._faults(message, said_by), ""))

    def heartbeat(self, message: Heartbeat, said_by: str) -> bool:
        """Whether to accept a heartbeat."""
        return self._judged(message, next(self._beat_faults(message, said_by), ""))

    def checkpoint(self, found: Checkpoint) -> Checkpoint:
        """The acceptable part of a checkpoint."""
        epochs = {
            app: epoch
            for app, epoch in list(found.epochs.items())[-MOST_APPS:]
            if _APP.fullmatch(app) and self._plausible(app, epoch)
        }
        kept = [one for one in found.registrations if not next(_own_faults(one, one.app_id), "")]
        left_out = len(found.epochs) - len(epochs) + len(found.registrations) - len(kept)
        if left_out:
            log.error("ignored %d implausible entries of the checkpoint", left_out)
        registrations, keys = [], 0
        for one in kept[: MOST_APPS * MOST_INSTANCES]:
            keys += len(one.capabilities) + len(one.interests)
            if keys <= MOST_KEYS:
                registrations.append(one)
        active = {app: instance for app, instance in found.active.items() if app in epochs}
        return Checkpoint(epochs=epochs, active=active, registrations=tuple(registrations))

    def _faults(self, message: Registration, said_by: str) -> Iterator[str]:
        yield from _own_faults(message, said_by)
        yield from self._crowded(message.app_id, message.instance_id)
        keys = self._registry.declared_keys(besides=message.instance_id)
        if keys + len(message.capabilities) + len(message.interests) > MOST_KEYS:
            yield f"all apps together declare more than {MOST_KEYS} keys: use wildcards"

    def _beat_faults(self, message: Heartbeat, said_by: str) -> Iterator[str]:
        yield from _names(message, said_by)
        if not self._plausible(message.app_id, message.epoch):
            yield f"epoch {message.epoch} is far beyond any that was given"
        if sum(map(len, (*message.offered, *message.held))) > _MOST_SHARD_TEXT:
            yield f"its shards have names of more than {_MOST_SHARD_TEXT} characters together"
        if message.written < 0 or message.received < 0 or message.version < 0:
            yield "a counter is negative"
        yield from self._crowded(message.app_id, message.instance_id)

    def _crowded(self, app: str, instance: str) -> Iterator[str]:
        known = self._registry.known(app)
        if known is None and self._registry.app_count() >= MOST_APPS:
            yield f"there are already {MOST_APPS} apps"
        if known is not None and instance not in known and len(known) >= MOST_INSTANCES:
            yield f"the app already has {MOST_INSTANCES} instances"

    def _plausible(self, app: str, epoch: int) -> bool:
        return 0 <= epoch <= min(MOST_EPOCH, self._registry.epoch(app) + EPOCH_STEP)

    def _judged(self, message: Registration | Heartbeat, fault: str) -> bool:
        if not fault:
            return True
        self.refused += 1
        kind = type(message).__name__.lower()
        refusal = Refusal(message.app_id[:_MOST_TEXT], message.instance_id[:_MOST_TEXT], f"{kind}: {fault}")
        if refusal not in self.last:
            log.error("refused a message of %r, instance %r: %s", *msgspec.structs.astuple(refusal))
        self.last.append(refusal)
        return False


def _own_faults(message: Registration, said_by: str) -> Iterator[str]:
    yield from _names(message, said_by)
    if not _HEARTBEAT_S[0] <= message.heartbeat <= _HEARTBEAT_S[1]:
        yield f"heartbeat {message.heartbeat:g} s is not within {_HEARTBEAT_S[0]:g} to {_HEARTBEAT_S[1]:g} s"
    if len(message.host) > _MOST_TEXT:
        yield f"the host's name is longer than {_MOST_TEXT} characters"


def _names(message: Registration | Heartbeat, said_by: str) -> Iterator[str]:
    if not _APP.fullmatch(message.app_id):
        yield "the app id is not one segment of A-Z a-z 0-9 _ -"
    if message.app_id != said_by:
        yield f"it came from the app {said_by[:_MOST_TEXT]!r}"
    if not _APP.fullmatch(message.instance_id):
        yield "the instance id is not of A-Z a-z 0-9 _ -"
    if message.revision < 0:
        yield "the revision is negative"
