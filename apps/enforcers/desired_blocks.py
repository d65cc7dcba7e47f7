"""What shall stand, and until when.  Pure: wall time in ns comes with every call.

Decisions carry capture time; an enforcer has the kernel's clock only.  So a block lasts as long as its decision
says, from the moment at which it was written.
"""

import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass, field

from apps.messages import Decision, Target


@dataclass(frozen=True)
class DesiredBlock:
    """One block that shall stand."""

    decision: Decision
    until: int
    """Wall time of its end, ns; 0 = none."""

    @property
    def id(self) -> str:
        """The decision's."""
        return self.decision.id

    @property
    def target(self) -> Target:
        """Whom it stops."""
        return self.decision.target

    def lasts(self, now: int) -> bool:
        """Whether it has not ended."""
        return not self.until or self.until > now


def desired_block_of(decision: Decision, written: int) -> DesiredBlock:
    """The desired_block of a block that was written at a wall time (ns)."""
    return DesiredBlock(decision, written + decision.expires - decision.event_time if decision.expires else 0)


@dataclass
class AllowedSenders:
    """The firewall's allow-list."""

    entries: tuple[str, ...] = ()
    _networks: list[ipaddress.IPv4Network | ipaddress.IPv6Network] = field(default_factory=list)
    _macs: set[str] = field(default_factory=set)

    def replace(self, entries: Iterable[str]) -> None:
        """Take another list; raises ValueError naming an entry that is none."""
        networks, macs = [], set()
        kept = tuple(entries)
        for entry in kept:
            if entry.count(":") == 5 and "::" not in entry and "/" not in entry:
                macs.add(entry.lower())
            else:
                networks.append(ipaddress.ip_network(entry, strict=False))
        self.entries, self._networks, self._macs = kept, networks, macs

    def cover(self, target: Target) -> bool:
        """Whether a block of this target would touch an allowed sender."""
        if target.kind == "mac":
            return target.address.lower() in self._macs
        network = ipaddress.ip_network(target.address)
        return any(network.overlaps(each) for each in self._networks)


class DesiredBlocks:
    """All desired by decision id: those that wait to be carried out, and those that stand."""

    def __init__(self) -> None:
        self.standing: dict[str, DesiredBlock] = {}
        self.adding: dict[str, DesiredBlock] = {}
        self.removing: dict[str, DesiredBlock] = {}

    def add(self, desired_block: DesiredBlock) -> bool:
        """A block shall stand; False if it stands already with the same end."""
        self.removing.pop(desired_block.id, None)
        if self.standing.get(desired_block.id) == desired_block:
            return False
        self.adding[desired_block.id] = desired_block
        return True

    def remove(self, decision_id: str) -> bool:
        """A block shall not stand any more; False if none of this id stands or waits."""
        waited = self.adding.pop(decision_id, None)
        stood = self.standing.get(decision_id)
        if stood is not None:
            self.removing[decision_id] = stood
        elif waited is not None:
            self.removing[decision_id] = waited
        return waited is not None or stood is not None

    def ended(self, now: int) -> list[str]:
        """Ids of the blocks whose end has come, and which are not being removed."""
        every = {**self.standing, **self.adding}
        return [
            name
            for name, desired_block in every.items()
            if not desired_block.lasts(now) and name not in self.removing
        ]

    def next_end(self) -> int:
        """Wall time of the next end, ns; 0 = none."""
        ends = [
            desired_block.until
            for desired_block in (*self.standing.values(), *self.adding.values())
            if desired_block.until
        ]
        return min(ends, default=0)

    def carried_out(self, refused: Iterable[str]) -> None:
        """What waited is done; those that were refused do not stand."""
        self.standing |= self.adding
        for name in (*self.removing, *refused):
            self.standing.pop(name, None)
        self.adding.clear()
        self.removing.clear()

    def __len__(self) -> int:
        return len(self.standing.keys() | self.adding.keys())
