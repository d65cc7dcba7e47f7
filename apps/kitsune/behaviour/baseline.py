"""How much more than in training: counts in sliding windows, weighed in nats.

For each statistic, each window length and each kind of what is counted (a protocol, a service; from inside or
outside) the highest count of all subjects in training is known, for some statistics also that of each subject.
Training is divided into blocks that are left out one by one.  How far a block is above all others is the scale of
an exponential tail.  How often one is, says how many counts above everybody's highest another training would show.
The bound of the sequential test is that of one such count for each of m senders; if there are n of them, whoever's
they are and in whatever statistic, then what is above everybody's highest weighs

    ln(m / n) + excess / scale

nats.  Rates of single conversations spread over orders of magnitude: of these the excess is that of the logarithms,
so that the tail is a power law, with an exponent of 2.5 at most.  A host is above its own highest as often as the
bound assumes, so that this weighs excess / scale only.  Blocks are long, so counts that belong together fall into
one, and no independence of packets is assumed.

Source: heavy tails of traffic (Crovella & Bestavros, Self-similarity in World Wide Web traffic, 1997); block maxima
and the jackknife (Coles, An Introduction to Statistical Modeling of Extreme Values, 2001, chapter 3; Efron, 1982).
"""

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Final, NamedTuple

WINDOWS_S: Final = (1.0, 10.0, 60.0, 600.0)
BLOCKS: Final = 10
"""Blocks into which training is divided."""
MOST_EVENTS: Final = 1_024
"""Events remembered of one subject; of more within a window the oldest do not count."""
MOST_SUBJECTS: Final = 65_536
FORGOTTEN_AT_A_TIME: Final = 2
"""Quiet subjects forgotten with each event: more than one, so that they become fewer."""
LEAST_SCALE: Final = 1.0
"""Events: the scale of the tail where training shows no variation at all."""
LEAST_SHARE: Final = 0.25
"""The scale is at least this share of the highest count of training."""
LEAST_LOG_SCALE: Final = 0.4
"""The same for logarithms of rates: a power law with an exponent of 2.5 at most, as rates of flows have."""
NEIGHBOURS_SHARE: Final = 0.1
"""A subject may do at least this share of what the busiest of all does: a quiet hour of training proves little."""


class SlidingSums:
    """Sums of the weights of events within the windows, for many subjects.

    Args:
        windows: lengths in seconds, ascending.
        most: subjects remembered; beyond it the one that was quiet longest is forgotten.
    """

    def __init__(self, windows: tuple[float, ...] = WINDOWS_S, most: int = MOST_SUBJECTS) -> None:
        self.windows = windows
        self._most = most
        self._events: dict[Any, tuple[list[float], list[float]]] = {}
        self.begun = (0.0,) * len(windows)
        """By window: the time of the first event of the sums that `add` returned last, seconds."""

    def __len__(self) -> int:
        """Subjects remembered."""
        return len(self._events)

    def add(self, subject: Any, time: float, weight: float = 1.0) -> tuple[float, ...]:
        """Add an event.

        Args:
            subject: hashable.
            time: seconds of capture time.
            weight: what it adds.

        Returns:
            The sum of the subject within each window, this event included.
        """
        self._forget_quiet(time)
        events = self._events.pop(subject, None)
        if events is None:
            events = ([], [0.0])
            if len(self._events) >= self._most:
                del self._events[next(iter(self._events))]
        self._events[subject] = events
        times, sums = events  # sums[i]: of all events before the i-th
        if times and time < times[-1]:
            time = times[-1]  # two ports may deliver in another order
        times.append(time)
        sums.append(sums[-1] + weight)
        aged = bisect_left(times, time - self.windows[-1])
        if len(times) > MOST_EVENTS:
            aged = max(aged, MOST_EVENTS // 4)
        if aged > len(times) // 8:
            del times[:aged], sums[:aged]
        firsts = [bisect_left(times, time - window) for window in self.windows]
        self.begun = tuple(times[first] for first in firsts)
        return tuple(sums[-1] - sums[first] for first in firsts)

    def _forget_quiet(self, time: float) -> None:
        """Forget the subjects that were quiet for longer than the longest window: their sums are 0 anyway."""
        since = time - self.windows[-1]
        for subject, (times, _) in list(islice(self._events.items(), FORGOTTEN_AT_A_TIME)):
            if times[-1] >= since:
                return
            del self._events[subject]


@dataclass
class BlockMaxima:
    """The highest counts of each block of training, by window."""

    blocks: dict[int, list[float]] = field(default_factory=dict)

    def see(self, block: int, counts: Iterable[float]) -> None:
        """Note counts seen in a block."""
        highest = self.blocks.get(block)
        if highest is None:
            self.blocks[block] = list(counts)
        else:
            self.blocks[block] = [max(pair) for pair in zip(highest, counts, strict=True)]

    def highest(self, windows: int, without: int = -1) -> list[float]:
        """The highest counts of all blocks but one."""
        columns = [0.0] * windows
        for block, counts in self.blocks.items():
            if block != without:
                columns = [max(pair) for pair in zip(columns, counts, strict=True)]
        return columns


def _excesses(
    maxima: Iterable[BlockMaxima], windows: int, early: int, relative: Callable[[float, float], float]
) -> tuple[float, float]:
    """Leave out each block in turn.

    Returns:
        The mean excess of a block above all others, in the units of `relative`; and how many
        blocks of a training are above all others, those apart in which everything was new.
    """
    ratios: list[float] = []
    exceeding = 0
    for each in maxima:
        for block, counts in each.blocks.items():
            rest = each.highest(windows, without=block)
            above = [(count, most) for count, most in zip(counts, rest, strict=True) if count > most]
            exceeding += bool(above) and block >= early
            ratios += [relative(count, most) for count, most in above if most]
    return sum(ratios) / len(ratios) if ratios else 0.0, exceeding * BLOCKS / (BLOCKS - early)


class Weighed(NamedTuple):
    """What a count weighs."""

    nats: float
    """0 if training saw as much."""
    window: int
    """Number of the window that it comes from."""
    usual: float
    """The highest count of training that it was compared with."""

    def or_more(self, nats: float, window: int, usual: float) -> "Weighed":
        """This weight, or another if that is more."""
        return Weighed(nats, window, usual) if nats > self.nats else self


class Baseline:
    """What training saw of one statistic.

    Args:
        windows: number of window lengths.
        least_scale: of the tail, where training shows no variation at all.
        own: compare a subject with its own highest counts, too.
        rates: counts are rates of conversations, whose tail is a power law; without `own`.
    """

    def __init__(
        self, windows: int, least_scale: float = LEAST_SCALE, *, own: bool = True, rates: bool = False
    ) -> None:
        self._windows = windows
        self.least_scale = least_scale
        self.own = own
        self.rates = rates
        self._least_share = LEAST_LOG_SCALE if rates else LEAST_SHARE
        self._learning: dict[Any, BlockMaxima] = {}
        self._kinds: dict[Any, BlockMaxima] = {}
        self.highest: dict[Any, list[float]] = {}
        """Highest counts by subject and window."""
        self.shared: dict[Any, list[float]] = {}
        """The same over all subjects, by kind: what somebody unknown may do."""
        self._own_scale = self._shared_scale = self._least_share
        self.exceeded = 0.0
        """How often a block of training was above all others, whoever's counts they were."""
        self.rarity = 0.0
        """Nats of being above everybody's highest count; set when all statistics have closed."""

    def learn(self, subject: Any, block: int, counts: tuple[float, ...], kind: Any = None) -> None:
        """Note counts of training.

        Args:
            subject: whose counts these are.
            block: the part of training, from 0.
            counts: by window.
            kind: hashable; subjects are compared with all others that do something of this kind.
        """
        kinds = self._kinds.get(kind)
        if kinds is None:
            # beyond that, kinds are as if training had not seen them
            kinds = BlockMaxima()
            if len(self._kinds) < MOST_SUBJECTS:
                self._kinds[kind] = kinds
        kinds.see(block, counts)
        if not self.own:
            return
        maxima = self._learning.get(subject)
        if maxima is None:
            if len(self._learning) >= MOST_SUBJECTS:
                return
            maxima = self._learning[subject] = BlockMaxima()
        maxima.see(block, counts)

    def close(self, early: int = 0) -> None:
        """End training.

        Args:
            early: blocks at its beginning in which all was new, and that say nothing about senders that are
                known by now; newcomers are compared with them nevertheless.
        """
        self.shared = {kind: maxima.highest(self._windows) for kind, maxima in self._kinds.items()}
        relative, self.exceeded = _excesses(self._kinds.values(), self._windows, early, self._relative)
        self._shared_scale = max(relative, self._least_share)
        late = {
            subject: BlockMaxima({block: counts for block, counts in maxima.blocks.items() if block >= early})
            for subject, maxima in self._learning.items()
        }
        self.highest = {subject: maxima.highest(self._windows) for subject, maxima in late.items()}
        self._own_scale = max(_excesses(late.values(), self._windows, early, self._relative)[0], LEAST_SHARE)
        self._learning.clear()
        self._kinds.clear()

    def _relative(self, count: float, most: float) -> float:
        """How far a block's count is above the highest of all others, in units that all kinds share."""
        if self.rates:
            return math.log((count + self.least_scale) / (most + self.least_scale))
        return (count - most) / (most + 1)

    def _excess(self, count: float, most: float) -> float:
        """Nats of a count above everybody's highest, without its rarity."""
        if self.rates:
            return self._relative(count, most) / self._shared_scale
        return (count - most) / max(self.least_scale, self._shared_scale * most)

    def nats(self, subject: Any, counts: tuple[float, ...], kind: Any = None) -> Weighed:
        """Weigh counts.

        Args:
            subject: whose counts these are; unknown ones are compared with the highest of their kind only.
            counts: by window, those of the shortest ones are enough.
            kind: as in training; of a kind that training does not know the highest count is 0.
        """
        own = self.highest.get(subject)
        best = Weighed(0.0, 0, 0.0)
        shared = self.shared.get(kind) or [0.0] * self._windows
        for number, (count, most) in enumerate(zip(counts, shared, strict=False)):
            if count > most:
                best = best.or_more(self.rarity + self._excess(count, most), number, most)
            if own is not None:
                usual = max(own[number], NEIGHBOURS_SHARE * most)
                if count > usual:
                    # who was quiet and becomes busy is so as others are
                    scale = max(self.least_scale, self._own_scale * usual, LEAST_SHARE * most)
                    best = best.or_more((count - usual) / scale, number, usual)
        return best

    @property
    def scales(self) -> tuple[float, float]:
        """Of the tails beyond a subject's own highest counts, and beyond everybody's, as shares of them."""
        return self._own_scale, self._shared_scale

    def names(self) -> tuple[set[Any], set[Any]]:
        """Names of the kinds, and of the subjects, that it knows or learns about."""
        return {*self.shared, *self._kinds}, {*self.highest, *self._learning}

    def to_state(self) -> dict[str, Any]:
        """Plain values for the model file."""
        return {
            "highest": [[subject, counts] for subject, counts in self.highest.items() if any(counts)],
            "shared": [[kind, counts] for kind, counts in self.shared.items() if any(counts)],
            "scales": [self._own_scale, self._shared_scale],
            "rarity": self.rarity,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """The inverse of `to_state`; subjects and kinds are lists there, tuples here.

        Raises:
            KeyError, TypeError, ValueError: the state is not one.
        """
        self.highest = {_frozen(subject): self._counts(counts) for subject, counts in state["highest"]}
        self.shared = {_frozen(kind): self._counts(counts) for kind, counts in state["shared"]}
        self._own_scale, self._shared_scale = map(float, state["scales"])
        self.rarity = float(state["rarity"])

    def _counts(self, counts: Iterable[Any]) -> list[float]:
        found = [float(count) for count in counts]
        if len(found) != self._windows:
            raise ValueError(f"{len(found)} counts for {self._windows} windows")
        return found


def _frozen(subject: Any) -> Any:
    return tuple(map(_frozen, subject)) if isinstance(subject, list) else subject
