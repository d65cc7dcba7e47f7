"""Which of several Coordinators is active.  Pure: time is an argument (s, monotonic).

    standby ──none active for 3 intervals──► active ──a better claim, or suspended──► standby

All announce themselves every interval.  One that starts or was suspended is a standby first, so it never contradicts
one that is active; of two active ones that with the higher term stays, at equal terms the one that started first.
"""

from typing import Annotated

import msgspec

_PATIENCE = 3.0
_MOST_TERM = 2**53
_TERM_STEP = 1 << 32
"""A claim with a term further ahead is refused."""


class Claim(msgspec.Struct, frozen=True, kw_only=True):
    """The announcement of a Coordinator."""

    instance_id: str
    started: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
    """UTC, ns.  Only breaks ties, so wrong clocks do no harm."""
    term: Annotated[int, msgspec.Meta(ge=0, le=_MOST_TERM)] = 0
    """Grows with each change of the active Coordinator."""
    active: bool = msgspec.field(default=False, name="leading")
    """Its name in the message is that of version 0.1: Coordinators of both versions understand each other."""

    @property
    def rank(self) -> tuple[int, int, str]:
        """Sort key; the smaller claim has precedence."""
        return -self.term, self.started, self.instance_id


class ActiveStandby:
    """One Coordinator's view of which one is active."""

    def __init__(self, instance_id: str, started: int, now: float, *, interval: float = 0.2) -> None:
        self.claim = Claim(instance_id=instance_id, started=started)
        self.active_instance = ""
        """Instance id of the active Coordinator; "" while unknown."""
        self._interval = interval
        self._quiet_since = now
        self._ticked = now
        self._announce_at = now

    @property
    def active(self) -> bool:
        return self.claim.active

    def heard(self, other: Claim, now: float) -> None:
        """Note the claim of another Coordinator."""
        mine = self.claim
        if other.instance_id == mine.instance_id or other.term > mine.term + _TERM_STEP:
            return
        if other.active and (not mine.active or other.rank < mine.rank):
            self._stand_by(now, active_instance=other.instance_id)
        elif other.instance_id == self.active_instance and not mine.active:
            # it steps down, so waiting in full is not needed
            self.active_instance = ""
            self._quiet_since = now - (_PATIENCE - 1) * self._interval
        elif not other.active and not mine.active and other.rank < mine.rank and not self.active_instance:
            # it started earlier and will become active
            self._quiet_since = now
        self.claim = msgspec.structs.replace(self.claim, term=max(self.claim.term, other.term * other.active))

    def tick(self, now: float) -> Claim | None:
        """What to announce now, if anything.  Call several times per interval."""
        patience = _PATIENCE * self._interval
        if now - self._ticked > patience:
            self._stand_by(now, active_instance="")
        self._ticked = now
        if not self.active and now - self._quiet_since > patience:
            self.claim = msgspec.structs.replace(self.claim, active=True, term=self.claim.term + 1)
            self.active_instance = self.claim.instance_id
            self._announce_at = now
        if now < self._announce_at:
            return None
        self._announce_at = now + self._interval
        return self.claim

    def resigned(self) -> Claim:
        """The last announcement of a Coordinator that stops."""
        return msgspec.structs.replace(self.claim, active=False)

    def _stand_by(self, now: float, *, active_instance: str) -> None:
        self.active_instance = active_instance
        self._quiet_since = now
        if self.claim.active:
            self.claim = msgspec.structs.replace(self.claim, active=False)
