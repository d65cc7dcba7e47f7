"""The protocol between an engine and the Coordinator: messages, and how a member reacts to them.

    engine ──Registration──► due.registration.<app>   at init and at every change of its declarations
    engine ──Heartbeat─────► due.heartbeat.<app>      every `heartbeat` seconds; `offline` once at the end
    engine ◄──Assignments─── due.assignment.<app>     its assignments, and which instance is active
    engine ◄──Heartbeat───── due.heartbeat.<app>      a standby instance also hears the others of its app

All are ordinary best-effort items (PUB_ONLY, NO_WAIT) whose value is `message.to_value()`.
Rules for the Coordinator:
 - it answers every Registration with Assignments to that app, and sends Assignments again whenever they change;
 - a Heartbeat of an unknown instance, of another `revision` than the registered one or with another
   `version` than the last sent is answered with the current Assignments: the instance sees in `revisions`
   that it is unknown, registers again and sends a heartbeat (so a restarted Coordinator knows all, and who
   was active, within two heartbeats);
 - `epoch` grows with each change of the active instance and never falls: a new Coordinator starts above
   the highest `epoch` in the heartbeats; Assignments with a lower epoch than seen are ignored;
 - `active` is "" for shared and sharded apps (every instance works) and while no instance is chosen for a standby app
   that has only consumers' duties it is the instance that reads;
 - each shard of a sharded app is given to one instance. It is given to another one only when the heartbeats of the
   first, of the version that took it away or a later one, do not list it as `held` any more, or have ended.
While no Coordinator answers, the instances of a standby app settle it among themselves by their heartbeats: see `Peers`;
so do those of a sharded app, of which then one works on everything.

`Member` holds the decisions.  Pure: no socket, no clock, no thread; time is an argument (seconds, monotonic).
"""

import enum
from collections.abc import Callable
from typing import Annotated, Any, Literal, Self

import msgspec

from due.codec import MAX_EPOCH, MAX_TIME
from due.config import MAX_HEARTBEAT
from due.keys import Key
from due.messages import Assignment, Capability, Frequency, Instances, Interest

REGISTRATION = "due.registration"
HEARTBEAT = "due.heartbeat"
ASSIGNMENT = "due.assignment"


APP_ID = r"[A-Za-z0-9_-]{1,64}"
"""Grammar of app ids and instance ids."""
MOST_DECLARED = 16_384
"""Capabilities, interests, assignments or instances in one message."""
MOST_SHARDS = 4096
"""Shards of one app; those beyond, in alphabetical order, are given to nobody."""
_MOST_TEXT = 2048
_MOST_PEERS = 1024
_MISSED = 4.0
"""Heartbeats after which a silent peer counts as ended; an instance that is cut off stops writing after three."""
_MOST_COUNT = 2**62
_CLAIMED_EPOCH = MAX_EPOCH - 2**24
"""The Coordinator continues from the epochs that instances claim, so these must leave it room to count."""

_Id = Annotated[str, msgspec.Meta(pattern=rf"\A{APP_ID}\Z")]
_NoId = Annotated[str, msgspec.Meta(pattern=rf"\A(?:{APP_ID})?\Z")]
_Text = Annotated[str, msgspec.Meta(max_length=_MOST_TEXT)]
_Host = Annotated[str, msgspec.Meta(max_length=255)]
_Count = Annotated[int, msgspec.Meta(ge=0, lt=_MOST_COUNT)]
_Seconds = Annotated[float, msgspec.Meta(gt=0.0, le=MAX_HEARTBEAT)]
_Many = msgspec.Meta(max_length=MOST_DECLARED)
_Shards = msgspec.Meta(max_length=MOST_SHARDS)


class _Message(msgspec.Struct, frozen=True, kw_only=True):
    def to_value(self) -> dict[str, Any]:
        """The message as a DUE value."""
        value = msgspec.to_builtins(self)
        return dict(value)

    @classmethod
    def from_value(cls, value: object) -> Self:
        """Read one from the wire; raises `msgspec.ValidationError` and nothing else."""
        try:
            return msgspec.convert(value, cls)
        except (
            ValueError,
            TypeError,
            AttributeError,
            RecursionError,
        ) as error:  # a number beyond a float's range, say
            if isinstance(error, msgspec.ValidationError):
                raise
            raise msgspec.ValidationError(f"{cls.__name__}: {error}") from None


class Registration(_Message, frozen=True, kw_only=True):
    """The capabilities and interests of one instance."""

    app_id: _Id
    instance_id: _Id
    instances: Instances = "standby"
    revision: _Count
    """Grows with each change of the following fields."""
    capabilities: Annotated[tuple[Capability, ...], _Many] = ()
    interests: Annotated[tuple[Interest, ...], _Many] = ()
    producer: bool = True
    consumer: bool = True
    heartbeat: _Seconds
    """Seconds between its heartbeats."""
    started: Annotated[int, msgspec.Meta(ge=0, le=MAX_TIME)]
    """UTC, ns: the order of instances."""
    host: _Host = ""
    pid: _Count = 0


class Heartbeat(_Message, frozen=True, kw_only=True):
    """A sign of life."""

    app_id: _Id
    instance_id: _Id
    state: Literal["online", "offline"] = "online"
    revision: _Count
    """Of its registration."""
    version: _Count = 0
    """Of the Assignments it follows; 0: none yet."""
    epoch: Annotated[int, msgspec.Meta(ge=0, le=_CLAIMED_EPOCH)] = 0
    """The highest seen."""
    active: bool = False
    """Whether it works now (a standby instance that waits says False)."""
    written: _Count = 0
    """Items written since its start."""
    received: _Count = 0
    """Items received since its start."""
    offered: Annotated[tuple[_Text, ...], _Shards] = ()
    """Shards that an instance of a sharded app could work on: those of the reliable keys that it observes."""
    held: Annotated[dict[_Text, _Count], _Shards] = {}
    """Shards that it works on, or of which it has not finished everything, and the grants by which it has them."""


class Incompatible(_Message, frozen=True, kw_only=True):
    """An interest that cannot be satisfied as asked, as DDS reports incompatible QoS."""

    key: _Text
    """The interest's key."""
    reason: _Text


class ShardGrant(msgspec.Struct, frozen=True, array_like=True):
    """A shard that was given to an instance."""

    instance: _Id
    number: _Count
    """Grows with each grant of the shard; 0: as the instance has it already."""


class Assignments(_Message, frozen=True, kw_only=True):
    """What the Coordinator asks of the instances of one app."""

    app_id: _Id
    coordinator: _Id
    """The Coordinator's instance id."""
    version: _Count
    """Changes with the content; never 0."""
    epoch: Annotated[int, msgspec.Meta(ge=0, le=MAX_EPOCH)]
    active: _NoId = ""
    """The instance that works; "" = every instance does."""
    shards: Annotated[dict[_Text, ShardGrant], _Shards] = {}
    """Of a sharded app: the instance that works on each shard; one that is not listed rests."""
    revisions: Annotated[dict[_Id, _Count], _Many]
    """The registrations it knows: instance id to revision."""
    assignments: Annotated[tuple[Assignment, ...], _Many] = ()
    incompatible: Annotated[tuple[Incompatible, ...], _Many] = ()


class Phase(enum.Enum):
    """State of the handshake."""

    WAITING = "waiting"
    """No message from a Coordinator yet: declared keys are buffered."""
    ALONE = "alone"
    """The handshake timed out: declared keys are written as if wanted."""
    COORDINATED = "coordinated"
    """A Coordinator answers: its assignments apply."""


class Verdict(enum.Enum):
    """How an item under a key is handled."""

    OPEN = "open"
    BUFFER = "buffer"
    UNWANTED = "unwanted"
    """Nobody wants it: archived only where the capability says always."""
    REFUSED = "refused"
    """This instance is not the active one, or was fenced off."""


class Standing(enum.Enum):
    """What an instance of a sharded app may do with a shard that it works on."""

    MINE = "mine"
    LEAVING = "leaving"
    """It is asked to hand it over: save, acknowledge, and let go."""
    LOST = "lost"
    """Another instance may work on it already: let go, and neither save nor acknowledge."""
    ASKING = "asking"
    """Not known at the moment."""


class Permission(msgspec.Struct, frozen=True):
    """How to treat the items of one concrete key, until `Member.changes` moves on."""

    verdict: Verdict
    capability: Capability | None = None
    frequency: float | None = None
    """Items a second; None: unpaced."""


class Peers:
    """The other instances of an app of which one works, by their heartbeats; which one while no Coordinator answers.

    One that works goes on, one that a Coordinator named before all others. Where none works, the one with the smallest
    id begins; and where two do, which were cut off from each other, it goes on.
    """

    def __init__(self, registration: Registration) -> None:
        self._me = registration.instance_id
        self._alone = registration.instances != "shared"
        self._beats: dict[str, tuple[float, Heartbeat]] = {}
        self.patience = _MISSED * registration.heartbeat
        """A peer silent for this many seconds has ended, or will ask before it writes again."""
        self.known = False
        """Whether there has ever been another."""

    def heard(self, message: Heartbeat, now: float) -> bool:
        """Note a heartbeat; returns whether its instance was not known."""
        name = message.instance_id
        if name == self._me or not self._alone:
            return False
        if message.state == "offline":
            self._beats.pop(name, None)
            return False
        new = name not in self._beats
        if new and len(self._beats) >= _MOST_PEERS:
            return False
        self._beats[name] = (now, message)
        self.known = True
        return new

    def active(self, now: float) -> bool:
        """Whether another instance works."""
        return any(beat.active for beat in self._living(now))

    def precede(self, now: float, *, working: bool) -> bool:
        """Whether another instance works, or is to begin before this one; `working`: this one works already."""
        for beat in self._living(now):
            named, first = beat.version > 0, beat.instance_id < self._me
            if beat.active and (named or first or not working):
                return True
            if not (working or named) and first:
                return True
        return False

    def _living(self, now: float) -> list[Heartbeat]:
        self._beats = {
            name: (at, beat) for name, (at, beat) in self._beats.items() if now - at <= self.patience
        }
        return [beat for _, beat in self._beats.values()]


Beat = Callable[[], Heartbeat]
"""Makes a heartbeat as of now."""


class Member:
    """One instance's view of its membership."""

    def __init__(
        self,
        registration: Registration,
        *,
        now: float,
        handshake_timeout: float,
        coordinated: bool = True,
        named: tuple[str, ...] = (),
    ) -> None:
        self.registration = registration
        self.named = named
        """The app's own shards; none: its reliable paths are."""
        self.offered = named
        """Of these the ones that this instance can work on."""
        self.phase = Phase.WAITING if coordinated else Phase.ALONE
        self.current: Assignments | None = None
        self.changes = 0
        """Grows when permissions may have changed."""
        self.epoch = 0
        self._coordinated = coordinated
        self._deadline = now + handshake_timeout
        self._handshake_timeout = handshake_timeout
        self._register_at = now
        self._beat_at = now
        self._fenced_until = 0.0
        self._fenced = False
        self._unheard = False
        """The question who is active could not be sent."""
        self._peers = Peers(registration)
        self._yields = False
        """No Coordinator answers, and another instance works."""
        self._grants: dict[str, int] = {}
        """Of the shards that this instance has."""
        self._lost: set[str] = set()
        """Shards that another instance may have got while this one was suspended."""

    @property
    def active(self) -> bool:
        """Whether this instance is active: writes and reads for its app."""
        if self._fenced or self._yields:
            return False
        return self.current is None or self.current.active in ("", self.registration.instance_id)

    @property
    def asking(self) -> bool:
        """Whether it was suspended or cut off for long and does not know yet if it is still active."""
        return self._fenced

    @property
    def reading(self) -> bool:
        """Whether it may read streams: a standby instance first waits to hear whether it is the active one."""
        return self.active and (self.phase is not Phase.WAITING or self.registration.instances == "shared")

    @property
    def shards(self) -> frozenset[str] | None:
        """The shards that are this instance's; None: it reads every stream."""
        if self.registration.instances != "sharded" or self.phase is Phase.ALONE:
            return None
        return frozenset(self._mine()) if self.active else frozenset()

    @property
    def named_here(self) -> frozenset[str] | None:
        """The app's own shards that are this instance's; None: not known at the moment."""
        if self._fenced or (self.phase is Phase.WAITING and not self._yields):
            return None
        return frozenset(self.named_held) if self.active else frozenset()

    @property
    def named_held(self) -> tuple[str, ...]:
        """The app's own shards that this instance had when that was last known."""
        mine = self._mine()
        return tuple(name for name in self.named if self.phase is Phase.ALONE or name in mine)

    def offer(self, names: tuple[str, ...], now: float) -> None:
        """From now on these are the shards that this instance can work on; a Coordinator hears it at once."""
        if names != self.offered:
            self.offered, self._beat_at = names, now

    def _mine(self) -> dict[str, int]:
        if self.current is None:
            return {}
        me = self.registration.instance_id
        return {shard: grant.number for shard, grant in self.current.shards.items() if grant.instance == me}

    def grant(self, shard: str) -> int:
        """The number of the grant by which this instance has a shard; 0: none."""
        return self._grants.get(shard, 0)

    def standing(self, shard: str, grant: int) -> Standing:
        """What it may do with a shard that it got by the grant of this number; 0: without one."""
        if self.registration.instances != "sharded" or self.phase is Phase.ALONE:
            return Standing.MINE
        if self._fenced or self.phase is Phase.WAITING or self.current is None:
            return Standing.ASKING
        now = self.current.shards.get(shard)
        if shard in self._lost:
            return Standing.LOST
        if now is None:
            return Standing.LEAVING
        mine = now.instance == self.registration.instance_id and (not grant or now.number in (0, grant))
        return Standing.MINE if mine else Standing.LOST

    def let_go(self, shard: str) -> None:
        """Nothing of a lost shard is left here."""
        self._lost.discard(shard)

    @property
    def announced(self) -> bool:
        """Whether this instance announces itself to a Coordinator."""
        return self._coordinated

    @property
    def assignments(self) -> tuple[Assignment, ...]:
        """What is wanted of this instance now."""
        return self.current.assignments if self.current is not None and self.active else ()

    def declare(
        self,
        now: float,
        *,
        capabilities: tuple[Capability, ...] | None = None,
        interests: tuple[Interest, ...] | None = None,
    ) -> None:
        """Replace what the registration says."""
        old = self.registration
        self.registration = msgspec.structs.replace(
            old,
            revision=old.revision + 1,
            capabilities=old.capabilities if capabilities is None else capabilities,
            interests=old.interests if interests is None else interests,
        )
        self._register_at = now
        self.changes += 1

    def tick(self, now: float, beat: Beat | None = None) -> list[Registration | Heartbeat]:
        """What to send now; `beat` makes heartbeats.  Call at least once per heartbeat."""
        self._settle(now)
        if self._fenced and now >= self._fenced_until:
            if self._peers.active(now):
                self._fenced_until = now + self._handshake_timeout
            else:
                self._fenced = False
                self.changes += 1
        if not self._coordinated:
            return []
        messages: list[Registration | Heartbeat] = []
        if now >= self._register_at:
            self._register_at = float("inf")
            messages.append(self.registration)
        if now >= self._beat_at:
            self._beat_at = max(self._beat_at + self.registration.heartbeat, now)
            messages.append((beat or self.beat)())
        return messages

    def _settle(self, now: float) -> None:
        """Without a Coordinator: work alone, unless another instance does or will."""
        if self.phase is Phase.COORDINATED:
            return
        works = self.phase is Phase.ALONE
        yields = self._peers.precede(now, working=works)
        if works and yields:
            self.phase, self._yields, self._deadline = Phase.WAITING, True, now
            self.changes += 1
        elif not works and now >= self._deadline and not (yields and self._yields):
            self.phase, self._yields = (Phase.WAITING, True) if yields else (Phase.ALONE, False)
            self.changes += 1

    def heard(self, message: Heartbeat, now: float) -> None:
        """A heartbeat of any instance of this app; a new one is answered at once."""
        if self._peers.heard(message, now):
            self._beat_at = now

    def next_tick(self) -> float:
        """When `tick` has something to do again."""
        if not self._coordinated:
            return float("inf")
        return min(self._register_at, self._beat_at)

    def beat(
        self,
        state: Literal["online", "offline"] = "online",
        *,
        written: int = 0,
        received: int = 0,
        offered: tuple[str, ...] = (),
        held: tuple[str, ...] = (),
    ) -> Heartbeat:
        """A heartbeat as of now."""
        kept = self._mine().keys() | held
        self._grants = {shard: number for shard, number in self._grants.items() if shard in kept}
        return Heartbeat(
            app_id=self.registration.app_id,
            instance_id=self.registration.instance_id,
            state=state,
            revision=self.registration.revision,
            version=self.current.version if self.current else 0,
            epoch=self.epoch,
            active=self.reading,
            written=written,
            received=received,
            offered=offered,
            held={shard: self._grants.get(shard, 0) for shard in held},
        )

    def assigned(self, message: Assignments, now: float) -> bool:
        """Apply the Coordinator's assignments; returns whether anything changed for this instance."""
        if message.app_id != self.registration.app_id or message.epoch < self.epoch:
            return False
        me = self.registration.instance_id
        if message.revisions.get(me) != self.registration.revision:
            self._register_at = min(self._register_at, now)
            if me not in message.revisions:
                self._beat_at = now  # tell a new Coordinator at once whether this instance is active
                return False
        before = (self.phase, self.active, self.assignments, self.epoch, self.shards)
        self.current = message
        self.epoch = message.epoch
        self.phase = Phase.COORDINATED
        self._grant(fenced=self._fenced)
        self._fenced = self._yields = False
        changed = before != (self.phase, self.active, self.assignments, self.epoch, self.shards)
        self.changes += changed
        return changed

    def _grant(self, *, fenced: bool) -> None:
        """Note the grants of `current`; what was not left here over a suspension is lost."""
        mine = self._mine()
        if fenced:
            self._lost |= {
                shard for shard, number in self._grants.items() if mine.get(shard) not in (0, number)
            }
        self._grants |= {s: number or self._grants.get(s, 0) for s, number in mine.items()}

    def paused(self, now: float) -> bool:
        """This process was suspended or cut off for longer than a Coordinator waits: another may be active by now.

        Writes are buffered until the Coordinator says who is active, or stays silent for the handshake
        time-out.  Returns whether this applies (only the active instance of a standby app, and those of a sharded one).
        """
        if self.phase is Phase.ALONE and self._peers.known:
            # one of them may work by now: their heartbeats tell
            self.phase, self._deadline, self._beat_at = Phase.WAITING, now + self._peers.patience, now
            self.changes += 1
            return True
        replaceable = self.current is not None and (
            self.current.active != "" or self.registration.instances == "sharded"
        )
        if not replaceable or not self.active:
            return False
        self._fenced = True
        self._fenced_until = now + self._handshake_timeout
        self._beat_at = now
        self._register_at = now
        self.changes += 1
        return True

    def connection(self, now: float, *, works: bool) -> None:
        """Whether Data Updates answers now; a question that could not be heard is asked again, with a new wait."""
        if not works and self.phase is Phase.WAITING and self._peers.known:
            self._deadline = max(self._deadline, now + self._peers.patience)
        if not self._fenced or (works and not self._unheard):
            return
        self._fenced_until = now + self._handshake_timeout
        self._unheard = not works
        if works:
            self._beat_at = self._register_at = now

    def permission(self, key: Key) -> Permission:
        """How to treat items written under the concrete `key`."""
        capability = self.capability(key)
        if self._fenced:
            return Permission(Verdict.BUFFER, capability)
        if not self.active:
            return Permission(Verdict.REFUSED, capability)
        if capability is None:
            return Permission(Verdict.OPEN)
        if self.phase is Phase.WAITING:
            return Permission(Verdict.BUFFER, capability)
        cap = most(capability.frequency)
        if self.phase is Phase.ALONE:
            return Permission(Verdict.OPEN, capability, cap)
        wanted = [a.frequency for a in self.assignments if Key.parse(a.key).matches(key)]
        if not wanted:
            return Permission(Verdict.UNWANTED, capability)
        rates = [rate for rate in wanted if rate is not None]
        rate = max(rates) if len(rates) == len(wanted) else None
        return Permission(Verdict.OPEN, capability, cap if rate is None else rate)

    def capability(self, key: Key) -> Capability | None:
        """The first declared capability under which `key` falls."""
        return next((c for c in self.registration.capabilities if Key.parse(c.key).offers(key)), None)

    def wanted(self, key: Key) -> bool:
        """Whether anybody wants what `key` (wildcards allowed) names, or no Coordinator can be asked."""
        if not self.active or self.phase is Phase.WAITING:
            return False
        if self.phase is Phase.ALONE:
            return True
        return any(key.offers(Key.parse(a.key)) for a in self.assignments)


def least(frequency: Frequency) -> float | None:
    """The minimum rate an interest asks for; None: every item."""
    return frequency[0] if isinstance(frequency, tuple) else frequency


def most(frequency: Frequency) -> float | None:
    """The maximum rate: a capability's number, or the second number of a pair; None: no limit."""
    return frequency[1] if isinstance(frequency, tuple) else frequency
