"""Traffic that fills tables in minutes: a chain of hosts that nobody has seen, each asks the next one once.

    office traffic, until Kitsune is trained ──► host 0 ⇄ host 1 ⇄ host 2 ⇄ … ──► a soak run with full tables

Half of them ask twice, and nothing answers the second request: contacts in vain are kept, too.  Some of them connect
to the next one by TCP in the end: the firewall, its controller and the switch keep sources with a finished handshake, and
their services.  Others have asked for a login before, and Kitsune keeps that.  At the end some hosts speak with ten others each: what
such a hub says is logged for the peers that have not heard it yet, and without them the number of these logs would grow
for hours.  Hosts with even numbers are on the side of the office.  A table at its cap forgets the oldest, or all, to take
the newest: memory that grows from then on is a leak.
"""

import struct
from collections.abc import Iterator, Mapping
from typing import Any, Final

from apps.firewall.settings import Settings
from apps.firewall.syn.syn_defence import SERVICES_LEARNT
from apps.kitsune.afterimage import MAX_LINKS, MAX_STREAMS, STREAMS_PER_LOG
from apps.kitsune.behaviour.behaviour import KEPT
from apps.kitsune.behaviour.contacts import MOST_CONTACTS

PAIRS: Final = round(2.1 * MOST_CONTACTS)
"""Contacts are kept in two generations, each up to its cap.  AfterImage's tables, and those of senders and
conversations, are smaller: a pair brings a stream to each of four tables, a link to each of two, and a sender.  Pairs
without a host in common would leave links at half of their cap, because a link ends with either of its streams."""
UNANSWERED: Final = round(1.05 * MOST_CONTACTS)
"""Of their requests."""
HANDSHAKES: Final = round(1.05 * max(Settings().known_limit, SERVICES_LEARNT))
"""Connections: each brings a known source and a service.  To a host goes one, so that nothing looks like a flood."""
LOGINS: Final = round(1.05 * KEPT)
"""SYNs to login services.  In the office traffic they take an hour and more until Kitsune forgets them."""
HUBS: Final = round(1.2 * MAX_STREAMS / STREAMS_PER_LOG)
"""Each has a log in two tables."""
PEERS: Final = 10
ROUNDS: Final = 26
"""A log keeps 256 packets."""
FRAMES: Final = 2 * PAIRS + UNANSWERED + 3 * HANDSHAKES + LOGINS + HUBS * PEERS * (ROUNDS + 1)
TRAINED: Final = 70_000
"""Frames of the office before: 55,000 of training, the rest is scored."""
CAPS: Final = {
    "streams": 4 * MAX_STREAMS,
    "links": 2 * MAX_LINKS,
    "hub_logs": 2 * MAX_STREAMS // STREAMS_PER_LOG,
}
"""Of those tables of which Kitsune's health says how full they are."""

_TOGETHER: Final = 64
"""Requests before their answers, and hosts behind one MAC: an answer must not overtake its request in the switch."""
_ADDRESSES: Final = 100 << 24 | 64 << 16
"""100.64.0.0/10 (RFC 6598), where nobody in the office traffic is."""
_MACS: Final = 0x02_66_00_000000
_PORT, _SILENT_PORT, _UDP, _LIFE = 20_000, 20_001, 17, 64
_TCP, _HTTPS, _SSH, _WINDOW = 6, 443, 22, 65_535
_SYN, _ACK = 0x02, 0x10
_CLIENTS, _SERVERS = 1_000, 5_000
"""Sequence numbers with which both ends begin."""
_PAYLOAD: Final = bytes(32)
_IP = struct.Struct("!BBHHHBBHII")
_PORTS = struct.Struct("!HHHH")
_SEGMENT = struct.Struct("!HHIIBBHHH")
_PSEUDO = struct.Struct("!IIHH")


def fill_frames(
    pairs: int = PAIRS,
    unanswered: int = UNANSWERED,
    handshakes: int = HANDSHAKES,
    logins: int = LOGINS,
    hubs: int = HUBS,
) -> Iterator[tuple[int, bytes]]:
    """Frames, and the end that each is sent into: 0 that of the office, 1 that of the Internet.

    Args:
        pairs: of neighbours in the chain.
        unanswered: requests without an answer, by the first hosts.
        handshakes: connections, by the first hosts, after all requests.
        logins: requests for a login without an answer, by the last hosts of the chain: who asked in vain twice would be
            blocked.
        hubs: hosts behind the chain that speak with ten others each, all at the same time.
    """
    # first: later they would push links out of the tables that the others fill
    for number in range(max(pairs - logins, 0), max(pairs, logins)):
        yield number % 2, _segment(number, number + 1, _SYN, _CLIENTS, 0, _SSH)
    for first in range(0, pairs, _TOGETHER):
        askers = range(first, min(first + _TOGETHER, pairs))
        for number in askers:
            yield number % 2, _frame(number, number + 1)
        for number in askers:
            yield (number + 1) % 2, _frame(number + 1, number)
        for number in range(first, min(first + _TOGETHER, pairs, unanswered)):
            yield number % 2, _frame(number, number + 1, _SILENT_PORT)
    for first in range(0, handshakes, _TOGETHER):
        clients = range(first, min(first + _TOGETHER, handshakes))
        for number in clients:
            yield number % 2, _segment(number, number + 1, _SYN, _CLIENTS, 0)
        for number in clients:
            yield (number + 1) % 2, _segment(number + 1, number, _SYN | _ACK, _SERVERS, _CLIENTS + 1)
        for number in clients:
            yield number % 2, _segment(number, number + 1, _ACK, _CLIENTS + 1, _SERVERS + 1)
    yield from _hub_frames(max(pairs, handshakes, logins) + 1, hubs)


def _hub_frames(first: int, hubs: int) -> Iterator[tuple[int, bytes]]:
    """Each hub speaks to its peers in turn; once they answer.  Every second number is on its side."""
    numbers = range(first + first % 2, first + first % 2 + hubs * 2 * PEERS, 2 * PEERS)
    for turn in range(ROUNDS):
        for hub in numbers:
            peers = range(hub + 1, hub + 2 * PEERS, 2)
            for peer in peers:
                yield 0, _frame(hub, peer)
            for peer in peers if turn == 0 else ():
                yield 1, _frame(peer, hub)


def fullness(health: Mapping[str, Any]) -> dict[str, dict[str, int]]:
    """From the Coordinator's /health: entries of Kitsune's tables and their caps."""
    told = health.get("apps", {}).get("kitsune", {}).get("health", {}).get("app", {})
    return {name: {"entries": int(told.get(name, 0)), "cap": cap} for name, cap in CAPS.items()}


def _frame(sender: int, receiver: int, port: int = _PORT) -> bytes:
    """A UDP datagram from one host to another, by their numbers."""
    datagram = _PORTS.pack(port, port, _PORTS.size + len(_PAYLOAD), 0) + _PAYLOAD
    return _packet(sender, receiver, _UDP, datagram)


def _segment(
    sender: int, receiver: int, flags: int, sequence: int, acknowledged: int, service: int = _HTTPS
) -> bytes:
    """A TCP segment of a connection to the host with the higher number."""
    ports = (_PORT, service) if sender < receiver else (service, _PORT)
    fields = *ports, sequence, acknowledged, _SEGMENT.size // 4 << 4, flags, _WINDOW
    pseudo = _PSEUDO.pack(_ADDRESSES + sender, _ADDRESSES + receiver, _TCP, _SEGMENT.size)
    checksum = _checksum(pseudo + _SEGMENT.pack(*fields, 0, 0))
    return _packet(sender, receiver, _TCP, _SEGMENT.pack(*fields, checksum, 0))


def _packet(sender: int, receiver: int, protocol: int, content: bytes) -> bytes:
    ends = _ADDRESSES + sender, _ADDRESSES + receiver
    header = _IP.pack(0x45, 0, _IP.size + len(content), 0, 0, _LIFE, protocol, 0, *ends)
    header = header[:10] + _checksum(header).to_bytes(2, "big") + header[12:]
    return _mac(receiver) + _mac(sender) + b"\x08\x00" + header + content


def _checksum(words: bytes) -> int:
    """Of an even number of bytes (RFC 1071)."""
    total: int = sum(struct.unpack(f"!{len(words) // 2}H", words))
    return ~(total % 0xFFFF) & 0xFFFF


def _mac(host: int) -> bytes:
    address: int = _MACS | host % 2 << 23 | host // (2 * _TOGETHER)
    return address.to_bytes(6, "big")
