"""Hosts that connect back to whoever has just logged in to them, as after a break-in.  Pure.

    login of A to B that training does not explain ──► remembered ──► B opens a connection to A ──► finding about A

Such a callback weighs by how rarely it happened in training to those that a host had reached (Laplace's rule of
succession: of n pairs k did so, so the next does with (k + 1) / (n + 2)).  It counts on top of the login, without
which it is nothing.  FTP's data connections and ident are callbacks by design and no sign of anything.
"""

import math
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

from apps.kitsune.behaviour.contacts import OTHER, TCP, Contact, EndedContact
from apps.kitsune.behaviour.rows import SenderId, parts_of
from apps.kitsune.roles import is_inside

SOON_S: Final = 60.0
"""Seconds after a login within which a connection back is a callback."""
MOST_LOGINS: Final = 4_096
_BY_DESIGN: Final = frozenset((TCP | 20, TCP | 113))


@dataclass(frozen=True, slots=True)
class _Visit:
    sender: SenderId
    service: int
    time: float


@dataclass(frozen=True, slots=True)
class Callback:
    """A host connected back."""

    sender: SenderId
    """Who had logged in."""
    host: int
    service: int
    """Where it had logged in."""
    seconds: float
    """Since then."""


class Callbacks:
    """Remembers logins, and detects hosts that connect back."""

    def __init__(self) -> None:
        self.pairs = 0
        """Hosts of training that somebody had reached, counted for each who had."""
        self.back = 0
        """Those of them that opened a connection back."""
        self._visits: OrderedDict[tuple[int, int], _Visit] = OrderedDict()

    @property
    def nats(self) -> float:
        """What a callback weighs."""
        return math.log((self.pairs + 2) / (self.back + 1))

    def learn(self, contacts: Iterable[Contact]) -> None:
        """Take the successful contacts of training; hosts also reach each other by ARP."""
        inside = [contact for contact in contacts if is_inside(parts_of(contact[1])) and contact[2] < OTHER]
        reached = {(source, target) for source, target, _ in inside}
        opened = {(source, target) for source, target, service in inside if service >> 16 == TCP >> 16}
        self.pairs = len(reached)
        self.back = sum((target, source) in opened for source, target in reached)

    def to_state(self) -> list[int]:
        """Plain values for the model file."""
        return [self.pairs, self.back]

    def restore(self, state: Iterable[Any]) -> None:
        """The inverse of `to_state`.

        Raises:
            TypeError, ValueError: the state is not one.
        """
        pairs, back = map(int, state)
        if not 0 <= back <= pairs:
            raise ValueError(f"{back} of {pairs} pairs connected back")
        self.pairs, self.back = pairs, back

    def login(self, sender: SenderId, source: int, host: int, service: int, time: float) -> None:
        """A login that training does not explain."""
        self._visits[source, host] = _Visit(sender, service, time)
        if len(self._visits) > MOST_LOGINS:
            self._visits.popitem(last=False)

    def heard(self, ended: EndedContact) -> Callback | None:
        """A new contact succeeded; returns the callback, if it is one."""
        if ended.service >> 16 != TCP >> 16 or {ended.service, ended.reverse} & _BY_DESIGN:
            return None
        host = ended.sender[3]
        visit = self._visits.get((ended.target, host))
        if visit is None or ended.time - visit.time > SOON_S:
            return None
        return Callback(visit.sender, host, visit.service, ended.time - visit.time)
