"""Who tries to reach whom, and whether that comes about.

    first packet towards a service ──► pending ──► completed (an answer; for TCP the handshake's end)
                                          └──► failed: RST, or nothing within the grace period

A contact is an address, another address and a service: a TCP or UDP port, ICMP echo, or ARP.  Only its first
attempt counts; contacts that training knows never do.  A scanner is known by its contacts that fail, and that few
come about (Jung et al., Fast Portscan Detection Using Sequential Hypothesis Testing, 2004).
"""

from collections import deque
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

GRACE_S: Final = 0.4
"""Seconds of capture time within which a contact must come about."""
MOST_CONTACTS: Final = 131_072
ECHO: Final = 1 << 24
ARP: Final = 2 << 24
OTHER: Final = 3 << 24
FROM_UDP: Final = 4 << 24
"""Datagrams from a well-known port, as reflectors send them."""
STRAY_TCP: Final = 5 << 24
"""Segments of connections that were never opened."""
ANY_UDP: Final = 6 << 24
"""Datagrams to many ports."""
TCP: Final = 6 << 16
UDP: Final = 17 << 16
_SYN, _RST, _ACK = 0x02, 0x04, 0x10

Contact = tuple[int, int, int]
"""Initiator's address, the other's, service."""


def service_text(service: int) -> str:
    """`tcp/22`, `udp/53`, `icmp`, `arp`; `from-udp/53`, `tcp-ack/80` and `udp` of floods."""
    if service >= ANY_UDP:
        return "udp"
    if service >= STRAY_TCP:
        return f"tcp-ack/{service & 0xFFFF}"
    if service >= FROM_UDP:
        return f"from-udp/{service & 0xFFFF}"
    if service >= OTHER:
        return "ip"
    if service >= ARP:
        return "arp"
    if service >= ECHO:
        return "icmp"
    return f"{'tcp' if service >> 16 == 6 else 'udp'}/{service & 0xFFFF}"


@dataclass(slots=True)
class _Pending:
    time: float
    sender: Any
    arrival: int
    reverse: int
    is_syn: bool
    half_open: bool = False


class EndedContact(NamedTuple):
    """A contact that came about, or failed."""

    failed: bool

    time: float
    sender: Any
    target: int
    service: int
    reverse: int
    """The initiator's port as a service, as of its first packet."""
    is_syn: bool
    """It began with a SYN."""
    arrival: int
    half_open: bool
    """The other side answered a SYN, and the handshake was not completed."""


class PacketRow(NamedTuple):
    """What the trackers need of a packet."""

    time: float
    arrival: int
    sender: Any
    """Identity of the sender."""
    to_mac: int
    source: int
    target: int
    service: int
    """Of the initiator, if this packet is from it: its destination port."""
    reverse: int
    """Of the initiator, if this packet answers it: its source port."""
    flags: int
    """TCP flags; 0 for others."""
    is_tcp: bool
    group: bool
    """To a multicast or broadcast address."""
    quoted: bool
    answer: bool
    """An ARP reply or an echo reply, which begins nothing."""
    length: int
    """Bytes on the wire."""


class ContactTracker:
    """Follows contacts; bounded by two generations of `MOST_CONTACTS`."""

    def __init__(self) -> None:
        self.trained: set[Contact] = set()
        """Contacts of training."""
        self._learning = True
        self._young: set[Contact] = set()
        self._old: set[Contact] = set()
        self._pending: dict[Contact, _Pending] = {}
        self._order: deque[tuple[float, Contact]] = deque()
        self._proven: dict[int, None] = {}
        self._vain: dict[Contact, None] = {}

    def close_training(self) -> None:
        """What is known by now is never counted again."""
        self.trained = self.seen()
        self._young, self._old = set(), set()
        self._learning = False

    def seen(self) -> set[Contact]:
        """All contacts of training and the recent past, failed ones included."""
        return self._young | self._old | self.trained

    def knows(self, contact: Contact) -> bool:
        """Whether training or the recent past have seen it."""
        return contact in self.trained or contact in self._young or contact in self._old

    def came_about(self, contact: Contact) -> bool:
        """Whether it is known and has not failed."""
        return self.knows(contact) and contact not in self._pending and contact not in self._vain

    def add(self, row: PacketRow) -> EndedContact | None:
        """Follow one packet; returns the contact that it ends, if there is one."""
        if row.quoted or row.group:
            return None
        back: Contact = (row.target, row.source, row.reverse)
        waiting = self._pending.get(back)
        if waiting is not None:
            return self._answered(row, back, waiting)
        if row.answer or self.knows(back):
            return None
        there: Contact = (row.source, row.target, row.service)
        mine = self._pending.get(there)
        if mine is not None:
            if mine.half_open and row.flags & _ACK and not row.flags & (_RST | _SYN):
                return self._complete(there, row.time)
            return None
        if self.knows(there) or (row.is_tcp and _never_begins(row.flags)):
            return None
        self._remember(there)
        if len(self._pending) < MOST_CONTACTS:
            self._pending[there] = _Pending(
                row.time, row.sender, row.arrival, row.reverse, bool(row.flags & _SYN)
            )
            self._order.append((row.time + GRACE_S, there))
        return None

    def due(self, now: float) -> list[EndedContact]:
        """Contacts whose grace period is over at `now` (seconds of capture time)."""
        failed = []
        while self._order and self._order[0][0] <= now:
            _, contact = self._order.popleft()
            pending = self._pending.get(contact)
            if pending is not None:
                failed.append(self._fail(contact, pending, pending.time + GRACE_S))
        return failed

    def _fail(self, contact: Contact, pending: _Pending, time: float) -> EndedContact:
        del self._pending[contact]
        if len(self._vain) >= MOST_CONTACTS:
            del self._vain[next(iter(self._vain))]
        self._vain[contact] = None
        return _ended(contact, pending, time, failed=True)

    def _answered(self, row: PacketRow, contact: Contact, pending: _Pending) -> EndedContact | None:
        if not row.is_tcp:
            return self._complete(contact, row.time)
        if row.flags & _RST:
            return self._fail(contact, pending, row.time)
        if row.flags & (_SYN | _ACK) == _SYN | _ACK:
            pending.half_open = True
            return None
        return self._complete(contact, row.time)

    def proven(self, address: int) -> bool:
        """Whether the address has completed a TCP handshake, so that nobody else can have sent under it."""
        return address in self._proven

    def _complete(self, contact: Contact, time: float) -> EndedContact:
        pending = self._pending.pop(contact)
        if pending.half_open:
            if len(self._proven) >= MOST_CONTACTS:
                del self._proven[next(iter(self._proven))]
            self._proven[contact[0]] = None
        return _ended(contact, pending, time, failed=False)

    def _remember(self, contact: Contact) -> None:
        self._young.add(contact)
        if len(self._young) >= MOST_CONTACTS:
            self._old, self._young = self._young, set()


def _ended(contact: Contact, pending: _Pending, time: float, *, failed: bool) -> EndedContact:
    _, target, service = contact
    return EndedContact(
        failed,
        time,
        pending.sender,
        target,
        service,
        pending.reverse,
        pending.is_syn,
        pending.arrival,
        pending.half_open,
    )


def _never_begins(flags: int) -> bool:
    return bool(flags & _RST) or flags & (_SYN | _ACK) == _SYN | _ACK
