"""Known instances, active instances, and assignments.  Pure: time is an argument (s, monotonic).

    Registration, Heartbeat, expire(now) ──► Registry ──► outgoing(): Assignments to send
                                                     └──► events(): what changed, for the archive

All state is soft: an unknown instance that sends a heartbeat is told so and registers again, and an
instance that is already active stays so (its heartbeats tell), so a Coordinator that starts or takes over
does not disturb a working pipeline.
"""

from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any

import msgspec

from coordinator.matching import Declarations, Matched, match
from coordinator.selection import Strategy, at_random
from coordinator.sharding import ShardTable
from due.membership import Assignments, Heartbeat, Registration

_SILENCE = 3.0
_SHORTEST_TIMEOUT_S = 0.3
"""However short its heartbeat is, an instance counts as unresponsive no sooner."""
_MOST_EPOCHS = 4096
"""Apps whose epochs are remembered after they have ended; the oldest is forgotten first."""
_MOST_EVENTS = 10_000
_MOST_CLAIMED = 2**53
"""Versions beyond are not believed, so that there is always room to count on."""


class InstanceState(Enum):
    """State of an instance."""

    ACTIVE = "active"
    """It is active."""
    IDLE = "idle"
    """A standby: another instance of its app is active."""
    UNRESPONSIVE = "unresponsive"
    """No heartbeat for longer than its interval allows."""
    OFFLINE = "offline"
    """It sent its offline heartbeat."""


@dataclass(slots=True)
class Instance:
    """What is known of one instance."""

    registration: Registration
    seen: float
    beat: Heartbeat | None = None
    gone: InstanceState | None = None

    @property
    def alive(self) -> bool:
        return self.gone is None


@dataclass(frozen=True, slots=True)
class Event:
    """One change; `instance_id` is empty where it concerns the app."""

    kind: str
    app_id: str
    instance_id: str = ""
    detail: str = ""

    def to_value(self) -> dict[str, str]:
        return {
            "event": self.kind,
            "app_id": self.app_id,
            "instance_id": self.instance_id,
            "detail": self.detail,
        }


class Checkpoint(msgspec.Struct, frozen=True, kw_only=True):
    """The part of the registry that is worth archiving."""

    epochs: dict[str, int]
    """Epoch of every app ever seen."""
    active: dict[str, str]
    """App id to its active instance."""
    registrations: tuple[Registration, ...]
    """Registrations of the live instances."""


class _App:
    """The instances of one app and their last assignments."""

    def __init__(self, epoch: int) -> None:
        self.instances: dict[str, Instance] = {}
        self.active = ""
        self.epoch = epoch
        self.sent: Assignments | None = None
        self.shards = ShardTable()
        self.unsettled = False
        """Heartbeats or instances have changed since the shards were settled."""

    @property
    def alive(self) -> list[Instance]:
        return [self.instances[name] for name in sorted(self.instances) if self.instances[name].alive]

    @property
    def standby(self) -> bool:
        return any(one.registration.instances == "standby" for one in self.alive)

    @property
    def sharded(self) -> bool:
        return any(one.registration.instances == "sharded" for one in self.alive)

    def declarations(self) -> Declarations:
        """The union of what live instances declare, each once."""
        registrations = [one.registration for one in self.alive]
        return Declarations(
            tuple(dict.fromkeys(c for r in registrations for c in r.capabilities)),
            tuple(dict.fromkeys(i for r in registrations for i in r.interests)),
        )

    def claim(self) -> str:
        """The live instance that a Coordinator made active in the newest epoch, or that works alone, or ""."""
        claims = [
            one.beat
            for one in self.alive
            if one.beat is not None
            and one.beat.active
            # what an instance said before it was replaced is not its word now
            and (one.beat.epoch >= self.epoch or not one.beat.version)
        ]
        return max(claims, key=lambda beat: (beat.version > 0, beat.epoch)).instance_id if claims else ""


class Registry:
    """The Coordinator's state.  Not thread-safe.

    `missed`: heartbeats an instance may miss before it counts as unresponsive.
    `forget_s`: seconds after which an instance that has ended is not listed any more.
    `first_epoch`, `version`: the first to use; higher than those of any earlier Coordinator.
    """

    def __init__(
        self,
        coordinator: str,
        *,
        select: Strategy = at_random,
        missed: float = 4.0,
        forget_s: float = 300.0,
        first_epoch: int = 1,
        version: int = 1,
    ) -> None:
        self.coordinator = coordinator
        self.active = False
        self.matched = Matched()
        self.failovers = 0
        self.changes = 0
        """Grows when a checkpoint would differ."""
        self._select = select
        self._missed = missed
        self._forget_s = forget_s
        self._apps: dict[str, _App] = {}
        self._epochs: dict[str, int] = {}
        self._remembered: dict[str, Registration] = {}
        self._preferred: dict[str, str] = {}
        self._first_epoch = first_epoch
        self._version = version
        self._heard: float | None = None
        self._looked: float | None = None
        self._active_since: float | None = None
        self._dirty = False
        self._answers: dict[str, None] = {}
        self._events: deque[Event] = deque(maxlen=_MOST_EVENTS)

    # --- what comes in -------------------------------------------------------------------------

    def registered(self, message: Registration, now: float) -> None:
        """An instance declares itself, for the first time or again."""
        app = self._app(message.app_id)
        known = app.instances.get(message.instance_id)
        self._hear(known, now)
        if known is None:
            app.instances[message.instance_id] = Instance(message, now)
            if self._remembered.pop(message.instance_id, None) is None:
                self._note("joined", message.app_id, message.instance_id)
        else:
            if not known.alive:
                self._note("returned", message.app_id, message.instance_id)
            known.registration, known.seen, known.gone = message, now, None
        self._dirty = True
        if self.active:
            self._answer(message.app_id)

    def beat(self, message: Heartbeat, now: float) -> None:
        """Take a heartbeat, or the last one."""
        app = self._app(message.app_id)
        if message.epoch > app.epoch:
            # an instance ignores an epoch older than the one it knows
            app.epoch, self._dirty = message.epoch, True
        remembered = self._remembered.get(message.instance_id)
        if remembered is not None:
            self._return_of(remembered, message, now)
        known = app.instances.get(message.instance_id)
        self._hear(known, now)
        if message.state == "offline":
            if known is not None and known.gone is not InstanceState.OFFLINE:
                self._lost(message.app_id, known, InstanceState.OFFLINE)
                known.seen = now
            return
        if known is None or known.registration.revision != message.revision:
            self._answer(message.app_id)
        if known is None:
            return
        if not known.alive:
            self._note("returned", message.app_id, message.instance_id)
            self._dirty = True
        known.seen, known.beat, known.gone = now, message, None
        # those of an earlier Coordinator, whose clock was ahead of this one's
        claims = (number for number in (message.version, *message.held.values()) if number <= _MOST_CLAIMED)
        self._version = max(self._version, *claims, 0)
        app.unsettled = True
        if self.active and (app.sent is None or app.sent.version != message.version):
            self._answer(message.app_id)

    def recall(self, checkpoint: Checkpoint) -> None:
        """Use an earlier Coordinator's checkpoint as a hint; known instances stay as they are."""
        for name, epoch in checkpoint.epochs.items():
            self._remember_epoch(name, epoch)
            if name in self._apps and self._apps[name].epoch < epoch:
                self._apps[name].epoch, self._dirty = epoch, True
        self._remembered = {one.instance_id: one for one in checkpoint.registrations}
        self._preferred = dict(checkpoint.active)

    def checkpoint(self) -> Checkpoint:
        """The checkpoint for the next Coordinator."""
        alive = [one.registration for app in self._apps.values() for one in app.alive]
        active = {name: app.active for name, app in self._apps.items() if app.active}
        return Checkpoint(epochs=self.epochs(), active=active, registrations=tuple(alive))

    def expire(self, now: float) -> None:
        """Mark silent instances unresponsive, and drop those that ended long ago.  Call often."""
        paused = now - self._looked if self._looked is not None else 0.0
        self._looked = now
        for name, app in list(self._apps.items()):
            for instance in list(app.instances.values()):
                if paused > _SHORTEST_TIMEOUT_S:
                    instance.seen = min(instance.seen + paused, now)
                silent = now - instance.seen
                if instance.alive and silent > self._patience(instance, now):
                    self._lost(name, instance, InstanceState.UNRESPONSIVE)
                elif not instance.alive and silent > self._forget_s:
                    del app.instances[instance.registration.instance_id]
            if not app.instances and name not in self._answers:
                self._remember_epoch(name, app.epoch)
                del self._apps[name]
        if self.active and self._active_since is None:
            self._active_since = now

    def activate(self) -> None:
        """This Coordinator is active from now on; active instances stay active."""
        self.active = True
        for name, app in self._apps.items():
            if app.active:
                # known from when this Coordinator was active before; what a heartbeat says comes first
                self._preferred[name] = app.active
            app.active = ""
        self._dirty = True

    def stand_by(self) -> None:
        """This Coordinator is a standby: only listen."""
        self.active = False
        self._active_since = None
        for app in self._apps.values():
            app.shards = ShardTable()

    # --- what goes out -------------------------------------------------------------------------

    def outgoing(self) -> list[Assignments]:
        """Assignments to send now: answers, and changes since the last call."""
        for app in self._apps.values() if self.active else ():
            # before anything is said: what an instance has and is not told of, it takes for withdrawn
            self._settle_shards(app)
        if self._dirty and self.active:
            self._dirty = False
            self.changes += 1
            self._elect()
            self._match()
        messages = []
        for name in self._answers:
            app = self._app(name)
            messages.append(
                app.sent if self.active and app.sent is not None else self._question(name, app.epoch)
            )
        self._answers.clear()
        return messages

    def events(self) -> list[Event]:
        """What changed since the last call."""
        events = list(self._events)
        self._events.clear()
        return events

    # --- what is known -------------------------------------------------------------------------

    def instances(self) -> Iterator[tuple[Instance, InstanceState]]:
        """Every instance that is listed, and its state."""
        for name in sorted(self._apps):
            app = self._apps[name]
            for instance in app.instances.values():
                yield instance, self._state(app, instance)

    def declarations(self) -> dict[str, Declarations]:
        """What the live instances of each app declare together."""
        return {name: self._apps[name].declarations() for name in sorted(self._apps)}

    def assignments(self) -> dict[str, Assignments]:
        """The last assignments of each app."""
        return {name: app.sent for name, app in sorted(self._apps.items()) if app.sent is not None}

    def known(self, app: str) -> Collection[str] | None:
        """Instance ids of a listed app."""
        return self._apps[app].instances.keys() if app in self._apps else None

    def app_count(self) -> int:
        """Listed apps."""
        return len(self._apps)

    def declared_keys(self, *, besides: str = "") -> int:
        """Capabilities and interests of all instances but one."""
        return sum(
            len(one.registration.capabilities) + len(one.registration.interests)
            for app in self._apps.values()
            for name, one in app.instances.items()
            if name != besides
        )

    def epoch(self, app: str) -> int:
        """The highest epoch of this app, at least the first epoch."""
        known = self._apps[app].epoch if app in self._apps else self._epochs.get(app, 0)
        return max(known, self._first_epoch)

    def epochs(self) -> dict[str, int]:
        """The highest epoch of every app ever seen."""
        return self._epochs | {name: app.epoch for name, app in self._apps.items()}

    # --- inside --------------------------------------------------------------------------------

    def _app(self, name: str) -> _App:
        if name not in self._apps:
            self._apps[name] = _App(self._epochs.get(name, 0))
        return self._apps[name]

    def _remember_epoch(self, name: str, epoch: int) -> None:
        self._epochs[name] = max(epoch, self._epochs.pop(name, 0))
        if len(self._epochs) > _MOST_EPOCHS:
            del self._epochs[next(iter(self._epochs))]

    def _timeout(self, instance: Instance) -> float:
        return max(self._missed * instance.registration.heartbeat, _SHORTEST_TIMEOUT_S)

    def _patience(self, instance: Instance, now: float) -> float:
        """Seconds to wait for a heartbeat; longer while no instance is heard, as then the connection is suspect."""
        timeout = self._timeout(instance)
        return timeout if self._heard is None or now - self._heard <= timeout else _SILENCE * timeout

    def _hear(self, sender: Instance | None, now: float) -> None:
        """Note a heartbeat; after a silence of all instances, none is marked unresponsive for it."""
        heard, self._heard = self._heard, now
        if heard is None or sender is None or now - heard <= _SHORTEST_TIMEOUT_S:
            return
        known = [one for app in self._apps.values() for one in app.instances.values()]
        blamed = [
            one
            for one in known
            if one.gone is not InstanceState.OFFLINE and heard - one.seen <= _SILENCE * self._timeout(one)
        ]
        timeouts = [self._timeout(one) for one in blamed if one.registration.heartbeat < self._forget_s]
        if not timeouts or now - heard <= max(timeouts):
            return
        for one in blamed:
            one.seen = now
            if not one.alive:
                one.gone = None
                self._dirty = True

    def _lost(self, name: str, instance: Instance, state: InstanceState) -> None:
        instance.gone = state
        self._dirty = self._apps[name].unsettled = True
        self._note(state.value, name, instance.registration.instance_id)

    def _state(self, app: _App, instance: Instance) -> InstanceState:
        if instance.gone is not None:
            return instance.gone
        waits = (
            instance.registration.instances == "standby" and app.active != instance.registration.instance_id
        )
        return InstanceState.IDLE if waits else InstanceState.ACTIVE

    def _elect(self) -> None:
        for name, app in self._apps.items():
            if not app.standby:
                app.active = "" if app.alive else app.active
                continue
            known = app.instances.get(app.active)
            if known is not None and known.alive:
                continue
            before, claim = app.active, app.claim()
            candidates = [(one.registration, one.beat) for one in app.alive]
            app.active = claim or self._former(name, app) or self._select(candidates)[0].instance_id
            app.epoch = max(app.epoch + 1, self._first_epoch)
            if before and before != app.active:
                self.failovers += 1
            self._note("activated", name, app.active, f"epoch {app.epoch}")

    def _settle_shards(self, app: _App) -> None:
        """Divide the shards of a sharded app among its instances."""
        if not app.unsettled or not app.sharded:
            return
        now, since = self._looked, self._active_since
        active_s = now - since if now is not None and since is not None else 0.0
        members = {one.registration.instance_id: one.beat for one in app.alive if one.beat is not None}
        unheard = len(members) < len(app.alive) or active_s < max(map(self._timeout, app.alive))
        app.unsettled = unheard
        if app.shards.settle(members, self._version + 1, unknown=unheard):
            self._dirty = True

    def _former(self, name: str, app: _App) -> str:
        """The active instance of the checkpoint, if it is alive."""
        known = app.instances.get(self._preferred.pop(name, ""))
        return known.registration.instance_id if known is not None and known.alive else ""

    def _return_of(self, remembered: Registration, message: Heartbeat, now: float) -> None:
        """Use a registration from the checkpoint, if it is still valid, instead of asking for a new one."""
        if message.state == "online" and remembered.revision == message.revision:
            self.registered(remembered, now)

    def _match(self) -> None:
        self.matched = match(self.declarations())
        for name, app in self._apps.items():
            if not app.alive:
                continue
            message = self._message(name, app)
            if app.sent is None or _content(app.sent) != _content(message):
                self._version += 1
                self._note_incompatible(name, app.sent, message)
                app.sent = msgspec.structs.replace(message, version=self._version)
                app.shards.told(self._version)
                self._answer(name)

    def _message(self, name: str, app: _App) -> Assignments:
        return Assignments(
            app_id=name,
            coordinator=self.coordinator,
            version=self._version,
            epoch=app.epoch,
            active=app.active,
            shards=dict(app.shards.given) if app.sharded else {},
            revisions={
                one.registration.instance_id: one.registration.revision
                for one in app.alive
                # one that has not said yet what it works on would take it that it has lost everything
                if one.beat is not None or one.registration.instances != "sharded"
            },
            assignments=tuple(
                msgspec.structs.replace(assignment, epoch=app.epoch)
                for assignment in self.matched.assignments.get(name, ())
            ),
            incompatible=self.matched.incompatible.get(name, ()),
        )

    def _question(self, name: str, epoch: int) -> Assignments:
        """Assignments without content: an instance that is not listed in them registers again."""
        return Assignments(
            app_id=name, coordinator=self.coordinator, version=self._version, epoch=epoch, revisions={}
        )

    def _answer(self, name: str) -> None:
        self._answers[name] = None

    def _note(self, kind: str, app: str, instance: str = "", detail: str = "") -> None:
        self._events.append(Event(kind, app, instance, detail))

    def _note_incompatible(self, name: str, before: Assignments | None, after: Assignments) -> None:
        known = set(before.incompatible) if before is not None else set()
        for one in after.incompatible:
            if one not in known:
                self._note("incompatible", name, detail=f"{one.key}: {one.reason}")


def _content(message: Assignments) -> tuple[Any, ...]:
    return (
        message.epoch,
        message.active,
        message.shards,
        message.revisions,
        message.assignments,
        message.incompatible,
    )
