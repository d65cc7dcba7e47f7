"""Which of several Coordinators leads.  Pure: time is an argument (s, monotonic).

    listening ──no leader for 3 intervals──► leading ──a better claim, or suspended──► listening

All announce themselves every interval.  One that starts or was suspended listens before it leads, so it
never contradicts a leader that is there; of two leaders the one with the higher term stays, at equal
terms the one that started first.
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
    """Grows with each change of the leader."""
    leading: bool = False

    @property
    def rank(self) -> tuple[int, int, str]:
        """Sort key; the smaller claim has precedence."""
        return -self.term, self.started, self.instance_id


class Leadership:
    """One Coordinator's view of who leads."""

    def __init__(self, instance_id: str, started: int, now: float, *, interval: float = 0.2) -> None:
        self.claim = Claim(instance_id=instance_id, started=started)
        self.leader = ""
        """Instance id of the leader; "" while unknown."""
        self._interval = interval
        self._quiet_since = now
        self._ticked = now
        self._announce_at = now

    @property
    def leading(self) -> bool:
        return self.claim.leading

    def heard(self, other: Claim, now: float) -> None:
        """Note the claim of another Coordinator."""
        mine = self.claim
        if other.instance_id == mine.instance_id or other.term > mine.term + _TERM_STEP:
            return
        if other.leading and (not mine.leading or other.rank < mine.rank):
            self._listen(now, leader=other.instance_id)
        elif other.instance_id == self.leader and not mine.leading:
            # it steps down, so waiting in full is not needed
            self.leader = ""
            self._quiet_since = now - (_PATIENCE - 1) * self._interval
        elif not other.leading and not mine.leading and other.rank < mine.rank and not self.leader:
            # it started earlier and will lead
            self._quiet_since = now
        self.claim = msgspec.structs.replace(
            self.claim, term=max(self.claim.term, other.term * other.leading)
        )

    def tick(self, now: float) -> Claim | None:
        """What to announce now, if anything.  Call several times per interval."""
        patience = _PATIENCE * self._interval
        if now - self._ticked > patience:
            self._listen(now, leader="")
        self._ticked = now
        if not self.leading and now - self._quiet_since > patience:
            self.claim = msgspec.structs.replace(self.claim, leading=True, term=self.claim.term + 1)
            self.leader = self.claim.instance_id
            self._announce_at = now
        if now < self._announce_at:
            return None
        self._announce_at = now + self._interval
        return self.claim

    def resigned(self) -> Claim:
        """The last announcement of a Coordinator that stops."""
        return msgspec.structs.replace(self.claim, leading=False)

    def _listen(self, now: float, *, leader: str) -> None:
        self.leader = leader
        self._quiet_since = now
        if self.claim.leading:
            self.claim = msgspec.structs.replace(self.claim, leading=False)
