"""Traffic for the benchmark of Sonata queries: an office at 6,000 packets a second, and attacks.

One minute is made and played over and over, with one attack of each kind in its first 20 seconds.  Two
servers, ten clients, long transfers, DNS, typed telnet, ARP, IPv6, ICMP errors and broken frames.  Frames
are cut behind their headers, as captures are; the switch's port pads them to their length on the wire.
"""

import random
from collections.abc import Iterator
from itertools import chain

from apps.sonata_adapter.catalogue import CATALOGUE
from tests.apps.sonata_adapter.traffic import (
    ACK,
    BASE_US,
    FIN,
    PSH,
    SYN,
    Frame,
    attack,
    office,
    tcp,
)

MINUTE_US = 60_000_000
MINUTE_PACKETS = 330_000
"""Frames in a minute, about."""
ATTACKS_END_US = 20_000_000
ATTACKS = len(CATALOGUE)
"""In a minute."""
_CONNECTIONS = 6
"""Begun in a second."""
_TELNET_GAP_US = 250_000
_IPV6_GAP_US = 200_000
_BEFORE_US = 10_000_000
"""So long before the minute transfers begin that still run in it."""
_HEAD = 54
_PAYLOAD = 48


def minutes(number: int, seed: int = 5) -> Iterator[tuple[list[Frame], list[Frame]]]:
    """For each minute the frames of its part with attacks, and those of the rest."""
    rng = random.Random(seed)
    quiet = sorted(_minute(rng), key=lambda frame: frame.time_us)
    edge = BASE_US + ATTACKS_END_US
    loud = [frame for frame in quiet if frame.time_us < edge]
    for place, name in enumerate(CATALOGUE):
        loud += attack(name, BASE_US + 500_000 + place * 1_500_000, rng)
    loud.sort(key=lambda frame: frame.time_us)
    rest = [frame for frame in quiet if frame.time_us >= edge]
    for minute in range(number):
        yield _shifted(loud, minute), _shifted(rest, minute)


def _shifted(frames: list[Frame], minute: int) -> list[Frame]:
    return [Frame(time_us + minute * MINUTE_US, length, data) for time_us, length, data in frames]


def _minute(rng: random.Random) -> list[Frame]:
    end = BASE_US + MINUTE_US
    begins = (BASE_US + rng.randrange(-_BEFORE_US, MINUTE_US) for _ in range(_CONNECTIONS * 70))
    transfers = chain.from_iterable(_transfer(begin, rng) for begin in begins)
    others = [frame for frame in office(60, rng) if _is_small_talk(frame)]
    return [
        frame for frame in (*transfers, *others, *_ipv6(), *_telnet(rng)) if BASE_US <= frame.time_us < end
    ]


def _is_small_talk(frame: Frame) -> bool:
    """DNS, ARP, ICMP and broken frames: what is not a connection of its own."""
    kind, is_tcp = frame.data[12:14], len(frame.data) > 23 and 6 in (frame.data[20], frame.data[23])
    return kind not in (b"\x08\x00", b"\x86\xdd") or not is_tcp


def _transfer(start: int, rng: random.Random) -> Iterator[Frame]:
    """A connection; requests and acknowledgements one way, much data the other."""
    client, server = f"10.0.0.{rng.randrange(10, 20)}", f"192.0.2.{rng.randrange(1, 3)}"
    sport, dport = rng.randrange(20_000, 60_000), rng.choices((443, 22), (97, 3))[0]
    there, back = (client, server, sport, dport), (server, client, dport, sport)
    acknowledge = tcp(*there, ACK, seq=101, ack=901)
    data = tcp(*back, PSH | ACK, bytes(_PAYLOAD), seq=901, ack=101)
    now = start
    yield Frame(now, 60, tcp(*there, SYN, seq=100))
    yield Frame(now + 400, 60, tcp(*back, SYN | ACK, seq=900, ack=101))
    yield Frame(now + 800, 60, acknowledge)
    yield Frame(now + 900, 300, tcp(*there, PSH | ACK, bytes(_PAYLOAD), seq=101, ack=901))
    for turn in range(round(min(6_000.0, 240 * rng.paretovariate(1.5)))):
        now += rng.randrange(200, 10_000)
        yield Frame(now, _HEAD + rng.randrange(200, 1_460), data)
        if turn % 2:
            yield Frame(now + 150, 60, acknowledge)
    yield Frame(now + 1_000, 60, tcp(*there, FIN | ACK, seq=401, ack=999))
    yield Frame(now + 1_400, 60, tcp(*back, FIN | ACK, seq=999, ack=402))


def _ipv6() -> Iterator[Frame]:
    """One connection that stays."""
    for now in range(BASE_US, BASE_US + MINUTE_US, _IPV6_GAP_US):
        yield Frame(now, 374, tcp("2001:db8::10", "2001:db8::1", 9_000, 443, ACK, bytes(_PAYLOAD)))


def _telnet(rng: random.Random) -> Iterator[Frame]:
    """Somebody types into an old device, key by key."""
    for now in range(BASE_US, BASE_US + MINUTE_US, _TELNET_GAP_US):
        key = bytes([rng.randrange(97, 123)])
        yield Frame(now, 60, tcp("10.0.0.12", "192.0.2.7", 41_000, 23, PSH | ACK, key))
