"""Contacts: which host tries to reach which, and whether it succeeds.

    first packet towards a service ──► pending ──► completed (an answer; for TCP the handshake's end)
                                          └──► failed: RST, or nothing within the grace period

A contact is an address, another address and a service: a TCP or UDP port, ICMP echo, or ARP.  Only its first
attempt counts; contacts that training knows never do.  Hosts of one LAN answer ARP requests within milliseconds: how
long to wait for that is learnt.  A scanner is known by its contacts that fail, and that few
come about (Jung et al., Fast Portscan Detection Using Sequential Hypothesis Testing, 2004).
"""

from collections import deque
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

GRACE_S: Final = 0.4
"""Seconds of capture time within which a contact must succeed."""
ARP_MARGIN: Final = 4.0
"""For an ARP reply this many times the longest wait of training is enough ..."""
LEAST_ARP_GRACE_S: Final = 0.1
"""... and never less than this: a wireless host that saves power hears of it with the next beacon ..."""
LEAST_ARP_REPLIES: Final = 100
"""... if as many pairs of hosts asked and answered in training, of whom only the first time counts: so the next one is
the slowest of all with a chance of one in a hundred."""
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
UNANSWERED: Final = 8 << 24
"""Echo requests without a reply, which are counted beside all of them."""
TCP: Final = 6 << 16
UDP: Final = 17 << 16
_SYN, _RST, _ACK = 0x02, 0x04, 0x10
_WELL_KNOWN: Final = 1_024

Contact = tuple[int, int, int]
"""Initiator's address, the other's, service."""


def service_text(service: int) -> str:
    """`tcp/22`, `udp/53`, `icmp`, `arp`; `from-udp/53`, `tcp-ack/80` and `udp` of floods."""
    if service >= UNANSWERED:
        return "icmp"
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
    """A contact that succeeded, or failed."""

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


def protocol_of(service: int) -> int:
    """The service without its port."""
    return service & ~0xFFFF


def flooded_service(failed: EndedContact) -> int:
    """What a victim is flooded with: a service, datagrams from a well-known port, stray segments."""
    if protocol_of(failed.service) == UDP and failed.reverse - UDP < _WELL_KNOWN:
        return FROM_UDP | failed.reverse - UDP
    if protocol_of(failed.service) == TCP and not failed.is_syn:
        return STRAY_TCP | failed.service - TCP
    return failed.service


class ContactTracker:
    """Follows contacts; bounded by two generations of `MOST_CONTACTS`."""

    def __init__(self) -> None:
        self.trained: set[Contact] = set()
        """Contacts of training."""
        self._learning = True
        self._young: set[Contact] = set()
        self._old: set[Contact] = set()
        self._pending: dict[Contact, _Pending] = {}
        self._order: tuple[deque[tuple[float, Contact]], deque[tuple[float, Contact]]] = (deque(), deque())
        """Ends of grace periods, each in order: of ARP requests, of all others."""
        self.arp_grace = GRACE_S
        """Seconds within which an ARP request must be answered."""
        self.arp_seen = 0, 0.0
        """ARP requests of training that were answered, and the longest wait for a reply."""
        self._proven: dict[int, None] = {}
        self._vain: dict[Contact, None] = {}

    def close_training(self) -> None:
        """What is known by now is never counted again."""
        if self._learning:
            self.arp_grace = arp_grace_of(*self.arp_seen)
        self.trained = self.seen()
        self._young, self._old = set(), set()
        self._learning = False

    def restore_grace(self, arp_grace: float) -> None:
        """A saved training has taught this; raises `ValueError`."""
        if not 0 < arp_grace <= GRACE_S:
            raise ValueError(f"{arp_grace} s for an ARP reply")
        self.arp_grace = arp_grace

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
            order = self._order[row.service != ARP]
            order.append((row.time + self._grace(row.service), there))
        return None

    def due(self, now: float) -> list[EndedContact]:
        """Contacts whose grace period is over at `now` (seconds of capture time)."""
        failed = []
        while first := min(
            (order for order in self._order if order), key=lambda order: order[0][0], default=None
        ):
            if first[0][0] > now:
                break
            _, contact = first.popleft()
            pending = self._pending.get(contact)
            if pending is not None:
                failed.append(self._fail(contact, pending, pending.time + self._grace(contact[2])))
        return failed

    def _grace(self, service: int) -> float:
        return self.arp_grace if service == ARP else GRACE_S

    def _fail(self, contact: Contact, pending: _Pending, time: float) -> EndedContact:
        del self._pending[contact]
        if len(self._vain) >= MOST_CONTACTS:
            del self._vain[next(iter(self._vain))]
        self._vain[contact] = None
        return _ended(contact, pending, time, failed=True)

    def _answered(self, row: PacketRow, contact: Contact, pending: _Pending) -> EndedContact | None:
        if not row.is_tcp:
            if self._learning and row.service == ARP:
                replies, slowest = self.arp_seen
                self.arp_seen = replies + 1, max(slowest, row.time - pending.time)
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


def arp_grace_of(replies: int, slowest: float) -> float:
    """Seconds to wait for an ARP reply, after a training with so many, the slowest of which took `slowest` seconds."""
    if replies < LEAST_ARP_REPLIES:
        return GRACE_S
    return min(max(LEAST_ARP_GRACE_S, ARP_MARGIN * slowest), GRACE_S)


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
