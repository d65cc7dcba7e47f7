"""AfterImage in plain Python: the tables.

Reference mode does at once, packet by packet, what the kernel defers; bounded mode (`afterimage`)
takes the kernel's steps in the kernel's order.  Both give bit-identical results, which tests check with
random traffic.
"""

import math
from collections import OrderedDict, deque
from typing import Final

from apps.kitsune.kernel import LAMBDAS

SCALES: Final = range(len(LAMBDAS))
LOG_KEPT: Final = 256
_ONES: Final = [1.0] * len(LAMBDAS)


def factors_of(dt: float) -> list[float]:
    return [math.pow(2, -rate * dt) for rate in LAMBDAS] if dt > 0 else _ONES


def damp(values: list[float], factors: list[float]) -> None:
    for k in SCALES:
        values[k] *= factors[k]


class DampedStream:
    """Damped sums of one key's packets, at five scales."""

    def __init__(self, key: str, time: float) -> None:
        self.key = key
        self.last = self.touched = time
        self.cf1, self.cf2, self.mean, self.var, self.std = ([0.0] * len(LAMBDAS) for _ in range(5))
        self.w = [1e-20] * len(LAMBDAS)
        self.links: dict[Link, None] = {}
        # bounded mode: a hub logs its packets, its peers list the links to hubs
        self.is_hub = False
        self.hub_links: dict[Link, None] = {}
        self.logged = 0
        self.spoken = 0.0
        self.count = [0.0] * len(LAMBDAS)
        self.residuals = [0.0] * len(LAMBDAS)
        self.log: deque[tuple[int, float, list[float]]] = deque(maxlen=LOG_KEPT)

    def decay(self, time: float) -> None:
        dt = time - self.last
        if dt > 0:
            self.last = time
            factors = factors_of(dt)
            for values in (self.cf1, self.cf2, self.w):
                damp(values, factors)

    def insert(self, value: float, time: float) -> None:
        self.decay(time)
        square = math.pow(value, 2)
        for k in SCALES:
            self.cf1[k] += value
            self.cf2[k] += square
            self.w[k] += 1
            self.mean[k] = self.cf1[k] / self.w[k]
            self.var[k] = abs(self.cf2[k] / self.w[k] - math.pow(self.mean[k], 2))
            self.std[k] = math.sqrt(self.var[k])

    def features(self) -> list[list[float]]:
        return [[self.w[k], self.mean[k], self.var[k]] for k in SCALES]


class Link:
    """Joint statistics of two streams; `ends[0]` sent first."""

    def __init__(self, first: DampedStream, second: DampedStream, time: float) -> None:
        self.ends = (first, second)
        self.last = time
        self.cf3 = [0.0] * len(LAMBDAS)
        self.w3 = [1e-20] * len(LAMBDAS)
        self.residual = [[0.0] * len(LAMBDAS), [0.0] * len(LAMBDAS)]
        # bounded mode: how much of each end's log was replayed, and the end's sums at that point
        self.seen = [0, 0]
        self.then = [0.0, 0.0]
        self.count_then: list[list[float]] = [[], []]
        self.residuals_then: list[list[float]] = [[], []]

    def side(self, stream: DampedStream) -> int:
        """Index of a stream in `ends`."""
        return 0 if self.ends[0] is stream else 1

    def decay(self, time: float) -> None:
        dt = time - self.last
        if dt > 0:
            self.last = time
            factors = factors_of(dt)
            damp(self.cf3, factors)
            damp(self.w3, factors)

    def update(self, side: int, residual: list[float], time: float) -> None:
        self.decay(time)
        other = self.residual[1 - side]
        for k in SCALES:
            self.cf3[k] += residual[k] * other[k]
            self.w3[k] += 1
        self.residual[side] = residual

    def features(self) -> list[list[float]]:
        first, second = self.ends
        rows = []
        for k in SCALES:
            cov, both = self.cf3[k] / self.w3[k], first.std[k] * second.std[k]
            radius = math.sqrt(math.pow(first.var[k], 2) + math.pow(second.var[k], 2))
            magnitude = math.sqrt(math.pow(first.mean[k], 2) + math.pow(second.mean[k], 2))
            rows.append([radius, magnitude, cov, cov / both if both != 0 else 0.0])
        return rows


class StatisticsTable:
    """Streams by key and links by pair."""

    def __init__(self) -> None:
        self.streams: OrderedDict[str, DampedStream] = OrderedDict()
        self.links: OrderedDict[tuple[str, str], Link] = OrderedDict()
        self.forgotten_idle = self.forgotten_full = 0

    def packet(self, key: str, value: float, time: float, *, jitter: bool = False) -> list[list[float]]:
        """A packet of a stream without links; in a jitter table its value is the time since the last packet."""
        self.begin(time)
        stream = self.enter(key, time)
        if jitter:
            value = max(time - stream.last, 0.0)
        stream.insert(value, time)
        return stream.features()

    def packet_to(self, key: str, peer_key: str, value: float, time: float) -> list[list[float]]:
        """A packet from one stream to another."""
        self.begin(time)
        stream = self.enter(key, time)
        self.prepare(stream)
        stream.insert(value, time)
        residual = [value - mean for mean in stream.mean]
        self._tell(stream, residual, time)
        own = stream.features()
        link = self._addressed(stream, self.enter(peer_key, time), time)
        far = link.ends[1 - link.side(stream)]
        self.prepare_link(link, stream, far)
        far.decay(time)
        link.update(link.side(stream), residual, time)
        return [first + second for first, second in zip(own, link.features(), strict=True)]

    def begin(self, time: float) -> None:
        """Hook: bounded mode makes room here."""

    def prepare(self, stream: DampedStream) -> None:
        """Bounded mode catches up with what the stream missed."""

    def prepare_link(self, link: Link, stream: DampedStream, far: DampedStream) -> None:
        """Bounded mode catches up with what the link missed."""

    def tell_peers(self, stream: DampedStream, residual: list[float], time: float) -> None:
        """Update all links of the sender with its packet."""
        for link in stream.links:
            near = link.side(stream)
            far = link.ends[1 - near]
            if far is not stream:
                self.prepare(far)
                far.decay(time)
                link.update(near, residual, time)

    def enter(self, key: str, time: float) -> DampedStream:
        """The stream of a key, created if it is new."""
        stream = self.streams.get(key)
        if stream is None:
            stream = self.streams[key] = DampedStream(key, time)
        return stream

    def renew(self, pair: tuple[str, str]) -> None:
        """Bounded mode notes that a link is in use."""

    def connect(self, link: Link) -> None:
        """A new link is listed with its ends."""
        for end in link.ends:
            end.links[link] = None

    def _tell(self, stream: DampedStream, residual: list[float], time: float) -> None:
        self_link = self.links.get((stream.key, stream.key))
        if self_link is not None:  # listed twice, as published
            self_link.update(0, residual, time)
            self_link.update(0, residual, time)
        self.tell_peers(stream, residual, time)

    def _addressed(self, stream: DampedStream, peer: DampedStream, time: float) -> Link:
        pair = pair_of(stream, peer)
        link = self.links.get(pair)
        if stream is peer and stream.links:
            # the published search takes a self pair for the first link of its stream
            link = next(iter(stream.links))
            pair = pair_of(*link.ends)
        if link is None:
            link = self.links[pair] = Link(stream, peer, time)
            self.connect(link)
        else:
            self.renew(pair)
        return link


def pair_of(first: DampedStream, second: DampedStream) -> tuple[str, str]:
    """The key of a link, the same for both directions."""
    return min(first.key, second.key), max(first.key, second.key)
