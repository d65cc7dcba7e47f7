"""Traffic for the benchmark of Sonata queries: an office at 5,500 packets a second, and attacks.

The first third has an attack of each kind in every 20 seconds, the rest has none.  Two servers, ten
clients, long transfers, DNS, typed telnet, ARP, IPv6, ICMP errors and broken frames.  Frames are cut
behind their headers, as captures are; the switch's port pads them to their length on the wire.
"""

import random
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.query.catalogue import PAPER
from sdnator.testing.query_traffic import (
    ACK,
    BASE_US,
    FIN,
    PSH,
    SYN,
    TimedFrame,
    attack,
    office,
    tcp,
)

MINUTE_PACKETS = 320_000
"""Frames in a minute, at least."""
ROUND_US = 20_000_000
"""From an attack to the next of its kind."""
ATTACKS = len(PAPER)
"""In a round."""
_MINUTE_S = 60
_CONNECTIONS = 6
"""Begun in a second."""
_TELNET_GAP_US = 250_000
_IPV6_GAP_US = 200_000
_BEFORE_S = 10
"""So long before the first frame transfers begin that still run then."""
_HEAD = 54
_PAYLOAD = 48


@dataclass(frozen=True)
class FrameColumns:
    """Frames in columns."""

    times_us: NDArray[np.int64]
    lengths: NDArray[np.int64]
    """On the wire."""
    data: Sequence[bytes]

    @classmethod
    def of(cls, frames: Sequence[TimedFrame]) -> "FrameColumns":
        """The frames, in their order."""
        times, lengths = ([getattr(frame, name) for frame in frames] for name in ("time_us", "length"))
        return cls(np.array(times), np.array(lengths), [frame.data for frame in frames])

    @classmethod
    def merged(
        cls, parts: Sequence[tuple[NDArray[np.int64], ...]], contents: Sequence[bytes]
    ) -> "FrameColumns":
        """Frames in the order of time, from (times, lengths, places in `contents`)."""
        times, lengths, places = (np.concatenate([part[column] for part in parts]) for column in range(3))
        order = np.argsort(times, kind="stable")
        return cls(times[order], lengths[order], [contents[place] for place in places[order].tolist()])

    def __len__(self) -> int:
        return len(self.data)

    def between(self, first_us: int, end_us: int) -> "FrameColumns":
        """Of frames in the order of time those from `first_us` on and before `end_us`."""
        span = slice(*np.searchsorted(self.times_us, (first_us, end_us)).tolist())
        return FrameColumns(self.times_us[span], self.lengths[span], self.data[span])


def traffic(minutes: int, seed: int = 5) -> tuple[FrameColumns, FrameColumns]:
    """The part with attacks, one of each kind for each minute, and the rest, twice as long."""
    rng = random.Random(seed)
    seconds = minutes * _MINUTE_S
    made = _Made()
    for _ in range(_CONNECTIONS * (seconds + _BEFORE_S)):
        made.transfer(BASE_US + rng.randrange(-_BEFORE_S * 10**6, seconds * 10**6), rng)
    made.add(frame for frame in office(seconds, rng) if _is_small_talk(frame))
    made.add((*_ipv6(seconds), *_telnet(seconds, rng)))
    for number in range(minutes):
        for place, name in enumerate(PAPER):
            made.add(attack(name, BASE_US + number * ROUND_US + 500_000 + place * 1_500_000, rng))
    whole, edge = made.traffic(), BASE_US + minutes * ROUND_US
    return whole.between(BASE_US, edge), whole.between(edge, BASE_US + seconds * 10**6)


class _Made:
    """Frames that have been made: transfers have few different ones."""

    def __init__(self) -> None:
        self._contents: list[bytes] = []
        self._parts: list[tuple[NDArray[np.int64], ...]] = []
        self._random = np.random.default_rng(5)

    def traffic(self) -> FrameColumns:
        return FrameColumns.merged(self._parts, self._contents)

    def add(self, frames: Iterable[TimedFrame]) -> None:
        for time_us, length, data in frames:
            self._repeat(data, np.array([time_us]), np.array([length]))

    def _repeat(self, data: bytes, times: NDArray[np.int64], lengths: NDArray[np.int64]) -> None:
        place = np.full(len(times), len(self._contents))
        self._contents.append(data)
        self._parts.append((times, lengths, place))

    def transfer(self, start: int, rng: random.Random) -> None:
        """A connection; requests and acknowledgements one way, much data the other."""
        client, server = f"10.0.0.{rng.randrange(10, 20)}", f"192.0.2.{rng.randrange(1, 3)}"
        sport, dport = rng.randrange(20_000, 60_000), rng.choices((443, 22), (97, 3))[0]
        there, back = (client, server, sport, dport), (server, client, dport, sport)
        acknowledge = tcp(*there, ACK, seq=101, ack=901)
        request = tcp(*there, PSH | ACK, bytes(_PAYLOAD), seq=101, ack=901)
        turns = round(min(6_000.0, 240 * rng.paretovariate(1.5)))
        times = start + 900 + np.cumsum(self._random.integers(200, 10_000, turns))
        last = int(times[-1])
        self.add((TimedFrame(start, 60, tcp(*there, SYN, seq=100)),))
        self.add((TimedFrame(start + 400, 60, tcp(*back, SYN | ACK, seq=900, ack=101)),))
        self.add((TimedFrame(start + 800, 60, acknowledge), TimedFrame(start + 900, 300, request)))
        sizes = _HEAD + self._random.integers(200, 1_460, turns)
        self._repeat(tcp(*back, PSH | ACK, bytes(_PAYLOAD), seq=901, ack=101), times, sizes)
        self._repeat(acknowledge, times[1::2] + 150, np.full(len(times[1::2]), 60))
        self.add((TimedFrame(last + 1_000, 60, tcp(*there, FIN | ACK, seq=401, ack=999)),))
        self.add((TimedFrame(last + 1_400, 60, tcp(*back, FIN | ACK, seq=999, ack=402)),))


def _is_small_talk(frame: TimedFrame) -> bool:
    """DNS, ARP, ICMP and broken frames: what is not a connection of its own."""
    kind, is_tcp = frame.data[12:14], len(frame.data) > 23 and 6 in (frame.data[20], frame.data[23])
    return kind not in (b"\x08\x00", b"\x86\xdd") or not is_tcp


def _ipv6(seconds: int) -> Iterator[TimedFrame]:
    """One connection that stays."""
    for now in range(BASE_US, BASE_US + seconds * 10**6, _IPV6_GAP_US):
        yield TimedFrame(now, 374, tcp("2001:db8::10", "2001:db8::1", 9_000, 443, ACK, bytes(_PAYLOAD)))


def _telnet(seconds: int, rng: random.Random) -> Iterator[TimedFrame]:
    """Somebody types into an old device, key by key."""
    for now in range(BASE_US, BASE_US + seconds * 10**6, _TELNET_GAP_US):
        key = bytes([rng.randrange(97, 123)])
        yield TimedFrame(now, 60, tcp("10.0.0.12", "192.0.2.7", 41_000, 23, PSH | ACK, key))
