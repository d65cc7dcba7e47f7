"""A query's counts in training, and how much more weighs how many nats.

For each host training knows the highest count of any window.  What is above it is weighed by an exponential
tail whose scale is learnt as well: training is divided into blocks, they are left out one by one, and the
excess of each over the highest count of all others is what a new maximum looks like here.

Source: block maxima and the jackknife (Coles, An Introduction to Statistical Modeling of Extreme Values, 2001,
chapter 3; Efron, 1982).
"""

import math
from collections.abc import Iterable
from statistics import median
from typing import Annotated, Final

from msgspec import Meta

from apps.evidence import MOST_NATS
from apps.messages import Message, Name, Number, Rate, Time

BLOCKS: Final = 10
"""Training is divided into at least this many blocks, and at most twice as many."""
MOST_HOSTS: Final = 16_384
"""Hosts of which the highest count is kept; the counts of others make the newcomers' highest."""
_LEAST_SCALE: Final = 1.0
"""The scale of the tail, in counts, where training shows no variation at all."""
_LEAST_SHARE: Final = 0.25
"""The scale is at least this share of the highest count of training."""
_EVERYBODY: Final = ""
_EULER: Final = 0.5772156649
"""Euler's constant: the mean of a Gumbel distribution is this many scales beyond its location."""
_LEAST_BLOCKS: Final = 8
"""With fewer block maxima their distribution is not estimated."""
_LEAST_RESULTS: Final = 30
"""With fewer results it is not estimated how many of them are of new hosts."""
_SETTLED: Final = 4
"""After a quarter of training, hosts that are seen for the first time count as new: all are at the beginning."""

Count = Annotated[float, Meta(ge=0, le=1e18)]


class CountBaseline(Message, frozen=True, kw_only=True):
    """`network.baseline.sonata_adapter.<query>`: what training saw of a query's counts."""

    text: Annotated[str, Meta(max_length=65_536)]
    """The query with the threshold at which it learnt; a baseline is of no use for another."""
    low: Annotated[int, Meta(ge=1, le=1 << 62)]
    """That threshold: a host without a count may have come as far as one below it."""
    newcomer: Count
    """The highest count of any host: what is normal for an unknown host."""
    middle: Count
    """The median of the hosts' highest counts: what is usual here is not suspicious of a quiet host either."""
    highest: Annotated[dict[Name, Count], Meta(max_length=MOST_HOSTS)]
    """The highest count by host, where it reached the threshold."""
    relative: Count = 0.0
    """Mean excess of a new maximum, as a share of the former one (plus one)."""
    maxima: Annotated[tuple[Count, ...], Meta(max_length=2 * BLOCKS)] = ()
    """The highest count of anybody in each block of training; what did not reach the threshold is one below it."""
    windows: Number = 0
    """Results of training."""
    host_windows: Number = 0
    """The same, but a host counts once in a window, whatever the number of switches; 0 if not every host was kept."""
    fresh: Number = 0
    """Hosts that reached the threshold for the first time when a quarter of training was over."""
    met: Annotated[tuple[Name, ...], Meta(max_length=MOST_HOSTS)] = ()
    """Hosts that reached it after training and were not reported (`KnownHosts`)."""
    seconds: Rate = 0.0
    """Capture time of training."""
    event_time: Time
    """Its end."""

    def usual(self, host: str) -> float:
        """The highest count that training allows a host."""
        return max(self.highest.get(host, self.newcomer), self.middle, self.low - 1.0)

    def scale(self, usual: float) -> float:
        """Counts beyond `usual` that weigh one nat."""
        return max(_LEAST_SCALE, max(self.relative, _LEAST_SHARE) * usual)

    def nats(self, host: str, count: float) -> float:
        """The weight of a count; 0 if training saw as much of this host, or of anybody if it does not know it."""
        usual = self.usual(host)
        return min(max(0.0, (count - usual) / self.scale(usual)), MOST_NATS)

    def rare(self, rate: float) -> int:
        """The count that anybody reaches this often, times an hour; at least one more than was ever seen.

        Block maxima have Gumbel's distribution where single counts have an exponential tail or a lighter one, as
        sums of many have.  Its location and scale are estimated by L-moments; the scale is taken larger by its
        standard error.

        Source: Coles (2001), chapter 3; Hosking, L-moments, Journal of the Royal Statistical Society B 52, 1990.
        """
        number = len(self.maxima)
        if number < _LEAST_BLOCKS or not self.seconds:
            nats = -math.log(rate * max(self.seconds, 1.0) / 3600)
            return max(self._beyond, self.count_of(nats, max(self.newcomer, self.low - 1.0)))
        return max(self._beyond, _exceeded(self.maxima, self._an_hour(number) / rate, _LEAST_SCALE))

    def rare_when_new(self, rate: float) -> int:
        """The count that hosts which are new here reach this often in all; no more than `rare` says of anybody.

        New hosts do what others do, but there are few of them: how many is estimated from those that were first seen
        when a quarter of training was over, and one more.  With a share of all results, less is extrapolated, and the
        scale may be smaller: where all of n block maxima are equal, one count more comes in less than one of n + 1
        blocks, which is ln(n + 1) scales.  If hosts differ, the highest counts of those of training tell how much.
        """
        number = len(self.maxima)
        if number < _LEAST_BLOCKS or not self.seconds or self.host_windows < _LEAST_RESULTS:
            return self.rare(rate)
        fresh = (self.fresh + 1) * _SETTLED / (_SETTLED - 1)
        share = min(1.0, fresh / (self.host_windows + 1))
        found = _exceeded(self.maxima, self._an_hour(number) * share / rate, 1 / math.log(number + 1))
        if len(self.highest) >= _LEAST_BLOCKS:
            found = max(found, _exceeded(self.highest.values(), self._an_hour(fresh) / rate, _LEAST_SCALE))
        return min(max(self._beyond, found), self.rare(rate))

    def _an_hour(self, number: float) -> float:
        return 3600 * number / max(self.seconds, 1.0)

    @property
    def _beyond(self) -> int:
        """One more than was ever seen."""
        return max(self.low, int(max(self.newcomer, self.low - 1.0)) + 1)

    def count_of(self, nats: float, usual: float) -> int:
        """The count that weighs this many nats for a host with this usual count."""
        return max(self.low, int(usual + nats * self.scale(usual)) + 1)


def _exceeded(maxima: Iterable[float], times: float, least_scale: float) -> int:
    """The count that one in so many such maxima reaches, by Gumbel's distribution with at least this scale."""
    ordered = sorted(maxima)
    number = len(ordered)
    mean = sum(ordered) / number
    spread = sum((2 * place - number + 1) * each for place, each in enumerate(ordered))
    scale = spread / (number * (number - 1)) / math.log(2)
    location = mean - _EULER * scale
    scale = max(least_scale, scale * (1 + 1 / math.sqrt(number)))
    return math.ceil(location + scale * math.log(times))


class CountTraining:
    """Counts of training, by host and block; the blocks grow with it."""

    def __init__(self) -> None:
        self._blocks: dict[str, dict[int, float]] = {}
        self._origin_us: int | None = None
        self._block_us = 0
        self._results = 0
        self._windows: dict[str, tuple[int, int, int]] = {}
        """For each host the first and the latest window with a result, us, and how many there were."""
        self._all_kept = True

    def learn(self, host: str, window_us: int, length_us: int, count: float) -> None:
        """Note the count of a window, which began at `window_us` (capture time)."""
        if self._origin_us is None:
            self._origin_us, self._block_us = window_us, length_us
        while (window_us - self._origin_us) // self._block_us >= 2 * BLOCKS:
            self._merge()
        self._results += 1
        block = max(0, (window_us - self._origin_us) // self._block_us)
        for name in (_EVERYBODY, host):
            if name in self._blocks or len(self._blocks) <= MOST_HOSTS:
                seen = self._blocks.setdefault(name, {})
                seen[block] = max(count, seen.get(block, 0.0))
            else:
                self._all_kept = False
        if host in self._blocks:
            first_us, latest_us, number = self._windows.get(host, (window_us, window_us - 1, 0))
            if window_us > latest_us:
                self._windows[host] = (first_us, window_us, number + 1)

    def close(self, text: str, low: int, *, begin_us: int, end_us: int) -> CountBaseline:
        """What was learnt; `begin_us` and `end_us`: capture time of training."""
        ratios: list[float] = []
        for blocks in self._blocks.values():
            ranked = sorted(blocks.values(), reverse=True)
            rest = max(ranked[1] if len(ranked) > 1 else 0.0, low - 1.0)
            if rest and ranked[0] > rest:
                ratios.append((ranked[0] - rest) / (rest + 1))
        highest = {name: max(blocks.values()) for name, blocks in self._blocks.items()}
        newcomer = highest.pop(_EVERYBODY, 0.0)
        settled_us = begin_us + (end_us - begin_us) // _SETTLED
        windows = self._windows.values() if self._all_kept else ()
        return CountBaseline(
            text=text,
            low=low,
            newcomer=newcomer,
            middle=median(highest.values()) if highest else 0.0,
            highest=highest,
            maxima=self._maxima(low, end_us),
            relative=sum(ratios) / len(ratios) if ratios else 0.0,
            windows=self._results,
            host_windows=sum(number for _, _, number in windows),
            fresh=sum(first_us >= settled_us for first_us, _, _ in windows),
            seconds=max(0, end_us - begin_us) / 1e6,
            event_time=end_us * 1000,
        )

    def _maxima(self, low: int, end_us: int) -> tuple[float, ...]:
        """Of anybody in each whole block, also in those before the first count."""
        seen = self._blocks.get(_EVERYBODY, {})
        if self._origin_us is None or not self._block_us:
            return ()
        number = min(2 * BLOCKS, max(max(seen, default=0) + 1, (end_us - self._origin_us) // self._block_us))
        return tuple(seen.get(block, low - 1.0) for block in range(number))

    def _merge(self) -> None:
        """Make blocks twice as long."""
        self._block_us *= 2
        for name, blocks in self._blocks.items():
            merged: dict[int, float] = {}
            for block, count in blocks.items():
                merged[block // 2] = max(count, merged.get(block // 2, 0.0))
            self._blocks[name] = merged
