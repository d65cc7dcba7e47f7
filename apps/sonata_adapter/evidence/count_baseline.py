"""A query's counts in training, and how much more weighs how many nats.

For each host training knows the highest count of any window.  What is above it is weighed by an exponential
tail whose scale is learnt as well: training is divided into blocks, they are left out one by one, and the
excess of each over the highest count of all others is what a new maximum looks like here.

Source: block maxima and the jackknife (Coles, An Introduction to Statistical Modeling of Extreme Values, 2001,
chapter 3; Efron, 1982).
"""

from statistics import median
from typing import Annotated, Final

from msgspec import Meta

from apps.evidence import MOST_NATS
from apps.messages import Message, Name, Number, Rate, Time

BLOCKS: Final = 10
"""Training is divided into so many blocks at least, twice as many at most."""
MOST_HOSTS: Final = 16_384
"""Hosts of which the highest count is kept; the counts of others make the newcomers' highest."""
_LEAST_SCALE: Final = 1.0
"""The scale of the tail, in counts, where training shows no variation at all."""
_LEAST_SHARE: Final = 0.25
"""The scale is at least this share of the highest count of training."""
_EVERYBODY: Final = ""

Count = Annotated[float, Meta(ge=0, le=1e18)]


class CountBaseline(Message, frozen=True, kw_only=True):
    """`network.baseline.sonata_adapter.<query>`: what training saw of a query's counts."""

    text: Annotated[str, Meta(max_length=65_536)]
    """The query with the threshold at which it learnt; a baseline is of no use for another."""
    low: Annotated[int, Meta(ge=1, le=1 << 62)]
    """That threshold: a host without a count may have come as far as one below it."""
    newcomer: Count
    """The highest count of any host: what somebody unknown may do."""
    middle: Count
    """The median of the hosts' highest counts: what is usual here is not suspicious of a quiet host either."""
    highest: Annotated[dict[Name, Count], Meta(max_length=MOST_HOSTS)]
    """The highest count by host, where it reached the threshold."""
    relative: Count = 0.0
    """Mean excess of a new maximum, as a share of the former one (plus one)."""
    windows: Number = 0
    """Results of training."""
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

    def count_of(self, nats: float, usual: float) -> int:
        """The count that weighs so many nats for a host with this usual count."""
        return max(self.low, int(usual + nats * self.scale(usual)) + 1)


class CountTraining:
    """Counts of training, by host and block; the blocks grow with it."""

    def __init__(self) -> None:
        self._blocks: dict[str, dict[int, float]] = {}
        self._origin_us: int | None = None
        self._block_us = 0
        self._results = 0

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
        return CountBaseline(
            text=text,
            low=low,
            newcomer=newcomer,
            middle=median(highest.values()) if highest else 0.0,
            highest=highest,
            relative=sum(ratios) / len(ratios) if ratios else 0.0,
            windows=self._results,
            seconds=max(0, end_us - begin_us) / 1e6,
            event_time=end_us * 1000,
        )

    def _merge(self) -> None:
        """Make blocks twice as long."""
        self._block_us *= 2
        for name, blocks in self._blocks.items():
            merged: dict[int, float] = {}
            for block, count in blocks.items():
                merged[block // 2] = max(count, merged.get(block // 2, 0.0))
            self._blocks[name] = merged
