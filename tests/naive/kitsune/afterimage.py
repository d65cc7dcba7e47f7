"""AfterImage in plain Python, with bounded mode: size limits, expiry, and catching up in one step.

A stream with many links (a hub) logs its packets instead of updating all its peers.  A peer applies
what it has missed when it is next needed: packet by packet while the log still has it, else in closed
form from the hub's damped sums.
"""

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from apps.kitsune.afterimage import HORIZON_S, MAX_LINKS, MAX_STREAMS, AfterImage, Mode
from apps.kitsune.kernel import Columns
from tests.naive.kitsune.afterimage_tables import (
    LOG_KEPT,
    SCALES,
    DampedStream,
    Link,
    StatisticsTable,
    damp,
    factors_of,
    pair_of,
)
from tests.naive.kitsune.text_keys import TextKeys, text_keys

HUB_DEGREE: Final = 8
HUBS_ASKED: Final = 32
STREAMS_PER_LOG: Final = 128
LEAST_LOGS: Final = 16
SET_BACK_S: Final = 60.0
"""A packet older than the newest by this much means that the clock was set back."""
_FORGET_AT_ONCE: Final = 3


class BoundedTable(StatisticsTable):
    """At most `max_streams` streams and `max_links` links; idle and oldest ones are forgotten."""

    def __init__(self, max_streams: int, max_links: int, horizon: float) -> None:
        super().__init__()
        self._max_streams, self._max_links, self._horizon = max_streams, max_links, horizon
        self._order = 0
        self.logging: dict[DampedStream, None] = {}
        self._most_logs = max(max_streams // STREAMS_PER_LOG, LEAST_LOGS)

    def begin(self, time: float) -> None:
        self._order += 1
        for _ in range(_FORGET_AT_ONCE):
            oldest = next(iter(self.streams.values()), None)
            if oldest is None or not time - oldest.touched > self._horizon:
                break
            self._forget_stream(oldest)
            self.forgotten_idle += 1
        while len(self.streams) > self._max_streams - 2:
            self._forget_stream(next(iter(self.streams.values())))
            self.forgotten_full += 1
        while len(self.links) > self._max_links - 1:
            self._forget_link(next(iter(self.links.values())))
            self.forgotten_full += 1

    def enter(self, key: str, time: float) -> DampedStream:
        if key in self.streams:
            self.streams.move_to_end(key)
        stream = super().enter(key, time)
        stream.touched = time
        return stream

    def renew(self, pair: tuple[str, str]) -> None:
        self.links.move_to_end(pair)

    def prepare(self, stream: DampedStream) -> None:
        if len(stream.hub_links) > HUBS_ASKED:
            return  # too many to update each: its links are updated when they are used
        pending = []
        for link in reversed(stream.hub_links):
            far = 1 - link.side(stream)
            hub = link.ends[far]
            missed = hub.logged - link.seen[far]
            if missed > LOG_KEPT:
                stream.decay(hub.spoken)
                _account(link, far)
            elif missed:
                events = list(hub.log)[len(hub.log) - missed :]
                pending += [(order, link, far, time, residual) for order, time, residual in events]
        pending.sort(key=lambda event: event[0])
        for _, link, far, time, residual in pending:
            stream.decay(time)
            link.update(far, residual, time)
        for link, far in dict.fromkeys((link, far) for _, link, far, _, _ in pending):
            _note(link, far)

    def prepare_link(self, link: Link, stream: DampedStream, far: DampedStream) -> None:
        self.prepare(far)
        if far is not stream:
            near = link.side(stream)
            for side in (1 - near, near):
                if link.ends[side].is_hub and link.seen[side] != link.ends[side].logged:
                    _account(link, side)

    def tell_peers(self, stream: DampedStream, residual: list[float], time: float) -> None:
        if not stream.is_hub:
            super().tell_peers(stream, residual, time)
            return
        if not stream.log:
            if len(self.logging) == self._most_logs:
                silent = sorted(self.logging, key=lambda hub: hub.log[-1][0])
                for hub in silent[: self._most_logs // 4]:
                    self._end_log(hub)
            self.logging[stream] = None
        stream.logged += 1
        stream.log.append((self._order, time, residual))
        if time > stream.spoken:
            factors = factors_of(time - stream.spoken)
            damp(stream.count, factors)
            damp(stream.residuals, factors)
            stream.spoken = time
        for k in SCALES:
            stream.count[k] += 1
            stream.residuals[k] += residual[k]

    def connect(self, link: Link) -> None:
        super().connect(link)
        if link.ends[0] is link.ends[1]:
            return
        for side, end in enumerate(link.ends):
            if end.is_hub:
                link.ends[1 - side].hub_links[link] = None
                _note(link, side)
            elif len(end.links) > HUB_DEGREE:
                end.is_hub = True
                end.spoken = end.last
                _become_hub(end)

    def _end_log(self, hub: DampedStream) -> None:
        """All peers catch up with a hub, which begins a new log with its next packet."""
        for link in hub.links:
            near = link.side(hub)
            if link.ends[0] is link.ends[1]:
                continue
            if link.seen[near] != hub.logged:
                _account(link, near)
            link.seen[near] = 0
        hub.logged = 0
        hub.log.clear()
        del self.logging[hub]

    def _forget_stream(self, stream: DampedStream) -> None:
        self.logging.pop(stream, None)
        for link in list(stream.links):
            self._forget_link(link)
        del self.streams[stream.key]

    def _forget_link(self, link: Link) -> None:
        del self.links[pair_of(*link.ends)]
        for side, end in enumerate(link.ends):
            end.links.pop(link, None)
            link.ends[1 - side].hub_links.pop(link, None)


def _become_hub(hub: DampedStream) -> None:
    for link in hub.links:
        near = link.side(hub)
        if link.ends[1 - near] is not hub:
            link.ends[1 - near].hub_links[link] = None
            _note(link, near)


def _note(link: Link, side: int) -> None:
    hub = link.ends[side]
    link.seen[side], link.then[side] = hub.logged, hub.spoken
    link.count_then[side], link.residuals_then[side] = hub.count.copy(), hub.residuals.copy()


def _account(link: Link, side: int) -> None:
    """Apply all packets of one end that the link has missed, in one step."""
    hub = link.ends[side]
    since = factors_of(hub.spoken - link.then[side])
    link.decay(hub.spoken)
    until = factors_of(link.last - hub.spoken)
    other = link.residual[1 - side]
    for k in SCALES:
        total = hub.residuals[k] - link.residuals_then[side][k] * since[k]
        link.cf3[k] += total * until[k] * other[k]
        link.w3[k] += (hub.count[k] - link.count_then[side][k] * since[k]) * until[k]
    link.residual[side] = hub.log[-1][2]
    _note(link, side)


class PythonAfterImage(AfterImage):
    """`AfterImage` without its kernel."""

    def __init__(
        self, mode: Mode = "reference", *, max_streams=MAX_STREAMS, max_links=MAX_LINKS, horizon=HORIZON_S
    ):
        self._engine = PythonEngine(mode == "bounded", max_streams, max_links, horizon)


class PythonEngine:
    """The four tables of AfterImage."""

    def __init__(self, bounded: bool, max_streams: int, max_links: int, horizon: float) -> None:
        self._bounded = bounded
        self._clock, self._offset = -math.inf, 0.0
        self._mac_ip, self._hosts, self._jitter, self._sockets = self._tables = [
            BoundedTable(max_streams, max_links, horizon) if bounded else StatisticsTable() for _ in range(4)
        ]

    def update(self, columns: Columns, out: npt.NDArray[np.float64]) -> None:
        """Writes the features of each row of the columns."""
        for row, keys in zip(out, text_keys(columns), strict=True):
            row[:] = self._features(keys, self._steady(keys.time) if self._bounded else keys.time)

    def _steady(self, time: float) -> float:
        """Bounded mode's clock, which never runs backwards."""
        if time + self._offset < self._clock - SET_BACK_S:
            self._offset = self._clock - time
        self._clock = max(self._clock, time + self._offset)
        return self._clock

    def _features(self, keys: TextKeys, time: float) -> list[float]:
        size = keys.length
        groups = (
            self._mac_ip.packet(keys.sender, size, time),
            self._hosts.packet_to(keys.source, keys.destination, size, time),
            self._jitter.packet(keys.source + keys.destination, 0.0, time, jitter=True),
            self._sockets.packet_to(keys.source_socket, keys.destination_socket, size, time),
        )
        return [value for group in groups for scale in group for value in scale]

    def counts(self) -> tuple[int, int, int, int, int]:
        """Streams, links, streams dropped for age, cells dropped for lack of room, logs."""
        streams, links = sum(len(t.streams) for t in self._tables), sum(len(t.links) for t in self._tables)
        return (
            streams,
            links,
            sum(table.forgotten_idle for table in self._tables),
            sum(table.forgotten_full for table in self._tables),
            sum(len(table.logging) for table in self._tables if isinstance(table, BoundedTable)),
        )
