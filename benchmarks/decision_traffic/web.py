"""What clients do in the Internet: pages, background requests, push connections.

A page asks for names, then opens connections to a few popular and some never seen hosts within seconds.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from benchmarks.decision_traffic import packets
from benchmarks.decision_traffic.flows import Fate, Talk, connect, talk, unanswered
from benchmarks.decision_traffic.habits import ask_names
from benchmarks.decision_traffic.hosts import Ends, Host
from benchmarks.decision_traffic.network import Habit, Network, Slice, public_addresses
from benchmarks.decision_traffic.packets import ACK, PSH
from benchmarks.decision_traffic.schedule import (
    Random,
    chance,
    every,
    hour_of_day,
    is_weekend,
    lognormal,
    poisson,
    within,
)
from benchmarks.decision_traffic.traffic import HOUR, SECOND, Ints, Tape

PAGE: Final = Talk(
    exchanges=2.2,
    response=(3_200, 1.5),
    think_s=(0.05, 1.6),
    linger_s=(4, 1.5),
    most_bytes=900_000,
    reset=0.12,
)
REQUEST: Final = Talk(exchanges=1.6, response=(1_500, 1.0), think_s=(0.03, 1.0), most_bytes=200_000)
INTERNET: Final = Fate(dead=0.008, refused=0.004, slow=0.008, lost=0.003)
DOWNLOAD: Final = Talk(
    exchanges=1, fixed_exchanges=True, response=(35_000_000, 0.6), gap_us=300, most_bytes=120_000_000
)
_DAY: Final = 24 * HOUR
_OUTAGES: Final = 0.25
"""Share of days on which the uplink fails for minutes."""
_NAMES_KEPT: Final = 0.55
"""Share of connections whose name is still in the client's cache."""


class Popularity:
    """Which hosts of the Internet this network speaks to: a few often, many once."""

    def __init__(self, network: Network, random: Random, *, pool: int = 2_500, once: float = 0.12) -> None:
        self._network = network
        self._pool = public_addresses(random, pool)
        self._once = once
        weights = 1 / np.arange(1, pool + 1) ** float(random.uniform(0.8, 1.05))
        self._sums = np.cumsum(weights) / weights.sum()
        self._rtt = np.clip(np.exp(random.normal(np.log(22), 0.7, pool)), 3, 260)
        self._outages: dict[int, tuple[int, int]] = {}

    def is_down(self, times: Ints) -> npt.NDArray[np.bool_]:
        """Whether the uplink is dead at these times: on one day of four for one to eight minutes."""
        days = times // _DAY
        down = np.zeros(len(times), np.bool_)
        for day in np.unique(days).tolist():
            if day not in self._outages:
                random = chance(self._network.seed, "outage", max(day, 0))
                begin = day * _DAY + int(random.integers(0, _DAY))
                lasting = int(random.integers(60, 480)) * SECOND if random.random() < _OUTAGES else 0
                self._outages[day] = begin, begin + lasting
            begin, end = self._outages[day]
            down |= (times >= begin) & (times < end)
        return down

    def choose(self, random: Random, count: int, share_once: float | None = None) -> tuple[Ends, Ints]:
        """Hosts for `count` connections, and the µs that each takes to answer."""
        once = random.random(count) < (self._once if share_once is None else share_once)
        row = np.minimum(np.searchsorted(self._sums, random.random(count)), len(self._pool) - 1)
        address = np.where(once, public_addresses(random, count), self._pool[row])
        rtt = np.where(once, random.uniform(15, 200, count), self._rtt[row])
        far = (rtt * random.uniform(0.95, 1.2, count) * 1_000).astype(np.int64)
        return self._network.outside(address), far

    def favourite(self, random: Random, among: int = 40) -> Ends:
        """One of the popular hosts."""
        return self._network.outside(self._pool[random.integers(0, among, 1)])


@dataclass(frozen=True, kw_only=True)
class Browsing:
    """When somebody is at a PC and what he does there."""

    pages_per_hour: float
    arrives: float
    """Hour of the day."""
    leaves: float
    weekends: bool
    quic: float
    """Share of connections that are QUIC."""

    def level(self, time: int) -> float:
        """0 (away) to 1 at a time of the network."""
        hour = hour_of_day(time)
        if is_weekend(time) and not self.weekends:
            return 0.0
        if not self.arrives <= hour < self.leaves:
            return 0.0
        return 0.35 if 12 <= hour < 13 else 1.0


def presence(taste: Browsing, random: Random, times: Ints) -> Ints:
    """The times at which somebody is there."""
    levels = np.array([taste.level(int(time)) for time in times])
    return times[random.random(len(times)) < levels] if len(times) else times


def browsing(network: Network, host: Host, popular: Popularity, taste: Browsing) -> Habit:
    """Pages in sessions: one page often follows another within a minute."""

    def habit(now: Slice) -> None:
        random = now.random
        sessions = presence(taste, random, poisson(random, now.start, now.end, taste.pages_per_hour / 3))
        pages = random.geometric(1 / 3, len(sessions))
        time = np.repeat(sessions, pages) + within(pages) * lognormal(
            random, 25 * SECOND, 0.8, int(pages.sum()), 240 * SECOND
        )
        visit(now.tape, random, time, host, network.gateway.ends, popular, quic=taste.quic)

    return habit


def downloads(host: Host, popular: Popularity, taste: Browsing) -> Habit:
    """Tens of megabytes at once, about once a week."""

    def habit(now: Slice) -> None:
        time = presence(taste, now.random, poisson(now.random, now.start, now.end, 0.025))
        server, far = popular.choose(now.random, len(time), 0.0)
        connections = connect(now.random, time, host.ends, server, 443)
        connections.far[:] = far
        talk(now.tape, now.random, connections, DOWNLOAD, Fate(lost=0.003))

    return habit


def visit(
    tape: Tape,
    random: Random,
    pages: Ints,
    client: Host,
    names: Ends,
    popular: Popularity,
    *,
    quic: float = 0.2,
    most: int = 40,
    share_once: float | None = None,
) -> None:
    """Open the pages: names first, then each page's connections within seconds."""
    counts = np.clip(random.lognormal(np.log(6), 0.7, len(pages)), 1, most).astype(np.int64)
    total = int(counts.sum())
    delay = np.where(within(counts) == 0, 20_000, lognormal(random, 700_000, 1.0, total, 8 * SECOND))
    time = np.repeat(pages, counts) + delay
    contact(tape, random, time, client, names, popular, quic=quic, share_once=share_once)


def contact(
    tape: Tape,
    random: Random,
    time: Ints,
    client: Host,
    names: Ends,
    popular: Popularity,
    *,
    what: Talk = PAGE,
    quic: float = 0.0,
    kept: float = _NAMES_KEPT,
    share_once: float | None = None,
) -> None:
    """Connections to hosts of the Internet, after their names were asked for where they are not known."""
    time = _refused_by_outage(tape, random, time, client, names, popular)
    server, far = popular.choose(random, len(time), share_once)
    asked = np.flatnonzero(random.random(len(time)) > kept)
    ask_names(tape, random, time[asked] - 15_000 - far[asked] // 2, client.ends, names)
    is_quic = random.random(len(time)) < quic
    quick, plain = np.flatnonzero(is_quic), np.flatnonzero(~is_quic)
    quic_talk(tape, random, time[quick], client.ends, server.at(quick), far[quick])
    port = np.where(random.random(len(plain)) < 0.93, 443, 80)
    connections = connect(random, time[plain], client.ends, server.at(plain), port, rtt_ms=(1, 2))
    connections.far[:] = far[plain]
    talk(tape, random, connections, what, INTERNET)


def _refused_by_outage(
    tape: Tape, random: Random, time: Ints, client: Host, names: Ends, popular: Popularity
) -> Ints:
    """Write what is tried in vain while the uplink is dead; returns the times of the rest."""
    down = popular.is_down(time)
    if not down.any():
        return time
    vain = time[down]
    server, _ = popular.choose(random, len(vain))
    unanswered(tape, random, connect(random, vain, client.ends, server, 443))
    asked = vain[random.random(len(vain)) < 0.5]
    ask_names(tape, random, asked, client.ends, names, unanswered=1.0)
    return time[~down]


def quic_talk(tape: Tape, random: Random, time: Ints, client: Ends, server: Ends, far: Ints) -> None:
    """QUIC: two full datagrams each way, then some bursts; one in a hundred is not answered."""
    sport = random.integers(49_152, 65_535, len(time))
    answered = random.random(len(time)) > 0.01
    bursts = random.geometric(0.3, len(time)) * answered
    good = np.flatnonzero(answered)
    back = server.at(good), client.at(good)
    for delay in (0, 1_200):
        packets.udp(tape, time + delay, client, server, sport=sport, dport=443, payload=1_250)
        later = (time + far)[good] + delay
        packets.udp(tape, later, *back, sport=443, dport=sport[good], payload=1_250)
    flow = np.repeat(np.arange(len(time)), bursts)
    begin = (
        time[flow] + 2 * far[flow] + within(bursts) * lognormal(random, 300_000, 1.0, len(flow), 20 * SECOND)
    )
    size = lognormal(random, 4, 0.9, len(flow), 60)
    packets.udp(
        tape,
        begin,
        client.at(flow),
        server.at(flow),
        sport=sport[flow],
        dport=443,
        payload=random.integers(33, 700, len(flow)),
    )
    row = np.repeat(np.arange(len(flow)), size)
    number = within(size)
    which = flow[row]
    at = begin[row] + far[which] + number * 220
    packets.udp(tape, at, server.at(which), client.at(which), sport=443, dport=sport[which], payload=1_250)
    third = np.flatnonzero(number % 3 == 2)
    packets.udp(
        tape,
        at[third] + 300,
        client.at(which[third]),
        server.at(which[third]),
        sport=sport[which[third]],
        dport=443,
        payload=36,
    )


def background(network: Network, host: Host, popular: Popularity, random: Random) -> Habit:
    """What programs ask for by themselves, in little groups, day and night where the machine stays on."""
    per_hour = float(random.lognormal(np.log(7), 0.5)) * (1.0 if host.always_on else 0.4)

    def habit(now: Slice) -> None:
        random = now.random
        groups = poisson(random, now.start, now.end, per_hour)
        counts = random.geometric(0.45, len(groups))
        time = np.repeat(groups, counts) + random.integers(0, 3 * SECOND, int(counts.sum()))
        contact(
            now.tape,
            random,
            time,
            host,
            network.gateway.ends,
            popular,
            what=REQUEST,
            kept=0.3,
            share_once=0.03,
        )

    return habit


def push(host: Host, popular: Popularity, random: Random) -> Habit:
    """A connection that stays open all day; every minute or few a small segment each way."""
    server, sport = popular.favourite(random), int(random.integers(49_152, 65_535))
    period, phase, far = random.uniform(28, 280), random.random(), int(random.uniform(9_000, 40_000))

    def habit(now: Slice) -> None:
        time = every(now.random, now.start, now.end, period, spread_s=period / 30, phase=phase)
        keep_open(now.tape, time, host, server, sport, far, period)

    return habit


def keep_open(
    tape: Tape, time: Ints, host: Host, server: Ends, sport: int, far: int, period_s: float, dport: int = 443
) -> None:
    """A small segment to the server, one back, and an acknowledgement, at each of these times."""
    turn = np.round(time / (period_s * SECOND)).astype(np.int64)
    seq, ack = 1_000 + 41 * turn, 9_000 + 39 * turn
    out: dict[str, int] = {"sport": sport, "dport": dport}
    back: dict[str, int] = {"sport": dport, "dport": sport}
    packets.tcp(tape, time, host.ends, server, flags=PSH | ACK, seq=seq, ack=ack, length=107, **out)
    packets.tcp(
        tape, time + far, server, host.ends, flags=PSH | ACK, seq=ack, ack=seq + 41, length=105, **back
    )
    packets.tcp(
        tape, time + far + 300, host.ends, server, flags=ACK, seq=seq + 41, ack=ack + 39, length=66, **out
    )
