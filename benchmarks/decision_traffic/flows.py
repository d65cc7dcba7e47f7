"""TCP connections, many at a time: handshake, requests and responses, close, and the ways in which they fail.

Each row of `Connections` is one connection.  `Talk` says what is said in it and how it ends, `Fate` how many
of them succeed.  The switch is between both ends: `near` is the time from a segment of the server's
side to the client's answer, `far` the other way round, so a server in the Internet has a long `far`.

Imitated: flags, directions, ports, sequence and acknowledgement numbers, delayed acknowledgements,
retransmissions, SYN retries after 1, 3 and 7 s.  Not imitated: windows; segments of a long transfer
come at an even pace with chance in it, not in rounds of a congestion window.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from benchmarks.decision_traffic import packets
from benchmarks.decision_traffic.hosts import Ends
from benchmarks.decision_traffic.packets import ACK, FIN, PSH, RST, SYN
from benchmarks.decision_traffic.schedule import Random, before, lognormal, spread_ms, within
from benchmarks.decision_traffic.traffic import SECOND, Column, Ints, Tape

SEGMENT: Final = 1_448
_HEAD: Final = 66
"""Ethernet, IP and TCP with time stamps."""
_SYN_LENGTH: Final = 74
_RETRIES_US: Final = (0, 1 * SECOND, 3 * SECOND, 7 * SECOND)
_C2S, _S2C = 0, 1


@dataclass(frozen=True, kw_only=True)
class Talk:
    """What is said in a connection; sizes are medians in bytes with the sigma of a log-normal distribution."""

    exchanges: float = 3.0
    """Mean number of requests (geometric, at least one)."""
    fixed_exchanges: bool = False
    """Exactly `exchanges` instead."""
    request: tuple[float, float] = (400, 0.8)
    response: tuple[float, float] = (2_500, 1.2)
    think_s: tuple[float, float] = (0.05, 1.5)
    """Before each request, median and sigma."""
    work_ms: tuple[float, float] = (3, 60)
    """What a server needs, from … to."""
    gap_us: float = 180.0
    """Mean time between full segments."""
    server_first: bool = False
    """The server greets with a banner (SSH, FTP, SMTP)."""
    most_bytes: int = 3_000_000
    most_think_s: float = 600.0
    linger_s: tuple[float, float] = (0.2, 1.5)
    """From the last response to the close, median and sigma."""
    server_closes: float = 0.2
    """Share that the server closes."""
    reset: float = 0.08
    """Share that ends with a RST of the client."""
    left_open: float = 0.02
    """Share whose end nobody sees."""


@dataclass(frozen=True, kw_only=True)
class Fate:
    """Shares of connections that fail at the start; the others succeed."""

    dead: float = 0.01
    """Nobody answers; the client tries up to four times."""
    refused: float = 0.004
    """The server's RST answers the SYN."""
    slow: float = 0.01
    """The first SYN is lost, the second answered."""
    lost: float = 0.002
    """Share of data segments that are sent twice."""


SOUND: Final = Fate(dead=0, refused=0, slow=0, lost=0.0005)
"""Within a LAN."""


@dataclass(frozen=True, eq=False)
class Connections:
    """One row for each connection; ends of one row stand for all."""

    time: Ints
    client: Ends
    server: Ends
    sport: Ints
    dport: Column
    far: Ints
    """µs from a segment towards the server to its answer, as the switch sees it."""
    near: Ints

    def __len__(self) -> int:
        return len(self.time)

    def only(self, rows: Ints) -> "Connections":
        """Some of them."""
        dport = self.dport if isinstance(self.dport, int) else self.dport[rows]
        return Connections(
            self.time[rows],
            self.client.at(rows),
            self.server.at(rows),
            self.sport[rows],
            dport,
            self.far[rows],
            self.near[rows],
        )


def fresh_ports(random: Random, count: int) -> Ints:
    """Source ports as clients choose them."""
    return random.integers(32_768, 61_000, count)


def connect(
    random: Random,
    time: Ints,
    client: Ends,
    server: Ends,
    dport: Column,
    *,
    rtt_ms: tuple[float, float] = (0.2, 0.9),
    inbound: bool = False,
    sport: Ints | None = None,
) -> Connections:
    """Connections at `time`; `rtt_ms` from … to of the far side, which is the client's where `inbound`."""
    count = len(time)
    long = spread_ms(random, count, *rtt_ms)
    short = spread_ms(random, count, 0.08, 0.5)
    ports = fresh_ports(random, count) if sport is None else sport
    far, near = (short, long) if inbound else (long, short)
    return Connections(time, client, server, ports, dport, far, near)


def talk(
    tape: Tape,
    random: Random,
    connections: Connections,
    what: Talk,
    fate: Fate = SOUND,
    *,
    attack: tuple[int, int] = (0, 0),
) -> Ints:
    """Write the connections on the tape; returns when each of them ends.

    `attack` holds the attack ids of the client's and the server's packets.
    """
    if not len(connections):
        return np.zeros(0, np.int64)
    draw = random.random(len(connections))
    dead = draw < fate.dead
    refused = ~dead & (draw < fate.dead + fate.refused)
    slow = ~dead & ~refused & (draw < fate.dead + fate.refused + fate.slow)
    unanswered(tape, random, connections.only(np.flatnonzero(dead)), attack=attack[0])
    _refused(tape, connections.only(np.flatnonzero(refused)), attack)
    ends = connections.time + 7 * SECOND
    alive = np.flatnonzero(~dead & ~refused)
    late = np.flatnonzero(slow)
    _syn(tape, connections.only(late), connections.time[late], attack[0])
    delayed = connections.time + np.where(slow, SECOND + 1_000, 0)
    moved = Connections(
        delayed,
        connections.client,
        connections.server,
        connections.sport,
        connections.dport,
        connections.far,
        connections.near,
    )
    ends[alive] = _Sessions(random, moved.only(alive), what, fate.lost).write(tape, attack)
    return ends


def unanswered(
    tape: Tape, random: Random, connections: Connections, *, tries: int = 4, attack: int = 0
) -> Ints:
    """SYNs that nobody answers, repeated; returns the times of all of them, in no order."""
    if not len(connections):
        return np.zeros(0, np.int64)
    times = []
    for delay in _RETRIES_US[:tries]:
        at = connections.time + delay
        if delay:
            at = at + spread_ms(random, len(at), 0, 12)
        _syn(tape, connections, at, attack)
        times.append(at)
    return np.concatenate(times) if times else np.zeros(0, np.int64)


def _isn(connections: Connections, salt: int) -> Ints:
    """Initial sequence numbers; the same for a SYN and its repetitions."""
    ports = np.asarray(connections.dport, np.int64) * 65_537 + connections.sport * 31
    mixed: Ints = (ports + connections.client.ip * 7 + connections.server.ip * 13 + salt) * 2_654_435_761
    return mixed & 0xFFFF_FFFF


def _syn(tape: Tape, connections: Connections, time: Ints, attack: int) -> None:
    if not len(connections):
        return
    packets.tcp(
        tape,
        time,
        connections.client,
        connections.server,
        sport=connections.sport,
        dport=connections.dport,
        flags=SYN,
        seq=_isn(connections, 1),
        length=_SYN_LENGTH,
        attack=attack,
    )


def _refused(tape: Tape, connections: Connections, attack: tuple[int, int]) -> None:
    if not len(connections):
        return
    _syn(tape, connections, connections.time, attack[0])
    packets.tcp(
        tape,
        connections.time + connections.far,
        connections.server,
        connections.client,
        sport=connections.dport,
        dport=connections.sport,
        flags=RST | ACK,
        ack=_isn(connections, 1) + 1,
        attack=attack[1],
    )


def _column(value: Column, count: int) -> Ints:
    return np.full(count, value, np.int64) if isinstance(value, int) else value


class _Sessions:
    """Connections that succeed: their segments in rows, numbered and written at the end."""

    def __init__(self, random: Random, connections: Connections, what: Talk, lost: float) -> None:
        self._random = random
        self._connections = connections
        self._what = what
        self._lost = lost
        self._rows: list[tuple[Ints, Ints, Ints, Ints, Ints]] = []
        """Connection, time, direction, flags, payload."""

    def write(self, tape: Tape, attack: tuple[int, int]) -> Ints:
        if not len(self._connections):
            return np.zeros(0, np.int64)
        started = self._handshake()
        ended = self._exchanges(started)
        closed = self._close(ended)
        self._number(tape, attack)
        return closed

    def _put(self, flow: Ints, time: Ints, direction: int, flags: Column, payload: Column = 0) -> None:
        if not len(flow):
            return
        full = [_column(value, len(flow)) for value in (direction, flags, payload)]
        self._rows.append((flow, time, full[0], full[1], full[2]))

    def _handshake(self) -> Ints:
        c = self._connections
        flows = np.arange(len(c))
        self._put(flows, c.time, _C2S, SYN)
        self._put(flows, c.time + c.far, _S2C, SYN | ACK)
        self._put(flows, c.time + c.far + c.near, _C2S, ACK)
        started = c.time + c.far + c.near
        if self._what.server_first:
            banner = started + c.far + spread_ms(self._random, len(c), *self._what.work_ms)
            self._put(flows, banner, _S2C, PSH | ACK, self._random.integers(20, 90, len(c)))
            self._put(flows, banner + c.near, _C2S, ACK)
            started = banner + c.near
        return started

    def _exchanges(self, started: Ints) -> Ints:
        what, random, c = self._what, self._random, self._connections
        count = len(c)
        if what.fixed_exchanges:
            counts = np.full(count, round(what.exchanges), np.int64)
        else:
            counts = random.geometric(1 / max(what.exchanges, 1.0), count)
        total = int(counts.sum())
        flow = np.repeat(np.arange(count), counts)
        far, near = c.far[flow], c.near[flow]
        requests = lognormal(random, *what.request, total, what.most_bytes)
        responses = lognormal(random, *what.response, total, what.most_bytes)
        ups, downs = -(-requests // SEGMENT), -(-responses // SEGMENT)
        think = lognormal(
            random, what.think_s[0] * SECOND, what.think_s[1], total, what.most_think_s * SECOND
        )
        work = spread_ms(random, total, *what.work_ms)
        gap = np.maximum(random.normal(what.gap_us, what.gap_us / 4, total), 12).astype(np.int64)
        sending = think + ups * gap
        lasting = sending + far + work + downs * gap + near
        begin = started[flow] + before(lasting, counts) + think
        self._segments(flow, begin, _C2S, requests, ups, gap)
        answer = begin + ups * gap + far + work
        slow = np.flatnonzero((work > 40_000) & (ups <= 2))
        self._put(flow[slow], (begin + ups * gap + far)[slow], _S2C, ACK)
        self._acknowledge(flow, begin + far, ups, gap, _S2C, np.where(ups > 2, (ups + 1) // 2, 0))
        self._segments(flow, answer, _S2C, responses, downs, gap)
        self._acknowledge(flow, answer + near, downs, gap, _C2S, (downs + 1) // 2)
        ended: Ints = (answer + downs * gap + near)[np.cumsum(counts) - 1]
        return ended

    def _acknowledge(
        self, flow: Ints, begin: Ints, segments: Ints, gap: Ints, direction: int, acks: Ints
    ) -> None:
        """One acknowledgement for each two segments, and one for the last."""
        rows = np.repeat(np.arange(len(flow)), acks)
        place: Ints = np.minimum(2 * within(acks) + 1, segments[rows] - 1)
        at = begin[rows] + place * gap[rows]
        self._put(flow[rows], at, direction, ACK)

    def _segments(
        self, flow: Ints, begin: Ints, direction: int, sizes: Ints, counts: Ints, gap: Ints
    ) -> None:
        rows = np.repeat(np.arange(len(flow)), counts)
        number = within(counts)
        last = number == counts[rows] - 1
        payload = np.where(last, sizes[rows] - number * SEGMENT, SEGMENT)
        jitter = self._random.integers(0, 4, len(rows)) * (gap[rows] >> 3)
        time = begin[rows] + number * gap[rows] + jitter
        flags = np.where(last, PSH | ACK, ACK)
        self._put(flow[rows], time, direction, flags, payload)

    def _close(self, ended: Ints) -> Ints:
        what, random, c = self._what, self._random, self._connections
        count = len(c)
        linger = lognormal(random, what.linger_s[0] * SECOND, what.linger_s[1], count, 120 * SECOND)
        at = ended + linger
        draw = random.random(count)
        resets = np.flatnonzero(draw < what.reset)
        self._put(resets, at[resets], _C2S, RST | ACK)
        closing = draw >= what.reset + what.left_open
        by_server = closing & (random.random(count) < what.server_closes)
        for rows, first in (
            (np.flatnonzero(by_server), _S2C),
            (np.flatnonzero(closing & ~by_server), _C2S),
        ):
            turn, back = (c.near, c.far) if first == _S2C else (c.far, c.near)
            self._put(rows, at[rows], first, FIN | ACK)
            self._put(rows, (at + turn)[rows], 1 - first, FIN | ACK)
            self._put(rows, (at + turn + back)[rows], first, ACK)
        return at + c.far + c.near

    def _number(self, tape: Tape, attack: tuple[int, int]) -> None:
        """Put the segments of each connection in order, number them, repeat some, and write them."""
        flow, time, direction, flags, payload = (
            np.concatenate(parts) for parts in zip(*self._rows, strict=True)
        )
        order = np.lexsort((time, flow))
        flow, time, direction, flags, payload = (
            column[order] for column in (flow, time, direction, flags, payload)
        )
        counts = np.bincount(flow, minlength=len(self._connections))
        taken = payload + ((flags & (SYN | FIN)) != 0)
        sent = [before(np.where(direction == side, taken, 0), counts) for side in (_C2S, _S2C)]
        c = self._connections
        first = [_isn(c, 1)[flow], _isn(c, 2)[flow]]
        is_client = direction == _C2S
        seq = np.where(is_client, first[0] + sent[0], first[1] + sent[1])
        ack = np.where(is_client, first[1] + sent[1], first[0] + sent[0]) * ((flags & ACK) != 0)
        again = np.flatnonzero((payload > 0) & (self._random.random(len(flow)) < self._lost))
        rows = np.concatenate([np.arange(len(flow)), again])
        delay = np.zeros(len(rows), np.int64)
        delay[len(flow) :] = spread_ms(self._random, len(again), 200, 900)
        length = np.where((flags & SYN) != 0, _SYN_LENGTH, payload + _HEAD)
        for side, src, dst, label in (
            (_C2S, c.client, c.server, attack[0]),
            (_S2C, c.server, c.client, attack[1]),
        ):
            chosen = np.flatnonzero(direction[rows] == side)
            mine = rows[chosen]
            who = flow[mine]
            dport = np.broadcast_to(c.dport, len(c))[who]
            ports = (c.sport[who], dport) if side == _C2S else (dport, c.sport[who])
            packets.tcp(
                tape,
                time[mine] + delay[chosen],
                src.at(who),
                dst.at(who),
                sport=ports[0],
                dport=ports[1],
                flags=flags[mine],
                seq=seq[mine],
                ack=ack[mine],
                length=length[mine],
                attack=label,
            )
