"""How much more than in training: counts in sliding windows, weighed in nats.

For each statistic and each window length a subject (a sender, a victim) has a highest count of training.  What
is above it is weighed by an exponential tail whose scale comes from training as well: its blocks are left out
one by one, and the excess of each over the highest count of all others is what a new maximum looks like here.
Blocks are long, so counts that belong together fall into one, and no independence of packets is assumed.

Source: block maxima and the jackknife (Coles, An Introduction to Statistical Modeling of Extreme Values, 2001,
chapter 3; Efron, 1982).
"""

from bisect import bisect_left
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

WINDOWS_S: Final = (1.0, 10.0, 60.0, 600.0)
BLOCKS: Final = 10
"""Blocks into which training is divided."""
MOST_EVENTS: Final = 1_024
"""Events remembered of one subject; of more within a window the oldest do not count."""
MOST_SUBJECTS: Final = 65_536
LEAST_SCALE: Final = 0.75
"""Events: the scale of the tail where training shows no variation at all."""
_LEAST_SHARE: Final = 0.25
"""The scale is at least this share of the highest count of training."""
_NEIGHBOURS_SHARE: Final = 0.1
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

    def add(self, subject: Any, time: float, weight: float = 1.0) -> tuple[float, ...]:
        """Add an event.

        Args:
            subject: hashable.
            time: seconds of capture time.
            weight: what it adds.

        Returns:
            The sum of the subject within each window, this event included.
        """
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
        return tuple(sums[-1] - sums[bisect_left(times, time - window)] for window in self.windows)


@dataclass
class SubjectMaxima:
    """The highest counts of one subject in training, by window; and those of each block."""

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


class Baseline:
    """What training saw of one statistic.

    Args:
        windows: number of window lengths.
        least_scale: of the tail, where training shows no variation at all.
    """

    def __init__(self, windows: int, least_scale: float = LEAST_SCALE) -> None:
        self._windows = windows
        self._least = least_scale
        self._learning: dict[Any, SubjectMaxima] = {}
        self.highest: dict[Any, list[float]] = {}
        """Highest counts by subject and window."""
        self.newcomer = [0.0] * windows
        """The same over all subjects: what somebody unknown may do."""
        self.relative = 0.0
        """Mean excess of a new maximum, as a share of the former one (plus one)."""

    def learn(self, subject: Any, block: int, counts: tuple[float, ...]) -> None:
        """Note counts of training; `block` is the part of training, from 0."""
        maxima = self._learning.get(subject)
        if maxima is None:
            if len(self._learning) >= MOST_SUBJECTS:
                return
            maxima = self._learning[subject] = SubjectMaxima()
        maxima.see(block, counts)

    def close(self, early: int = 0) -> None:
        """End training.

        Args:
            early: blocks at its beginning in which all was new, and that say nothing about senders that are
                known by now; newcomers are compared with them nevertheless.
        """
        ratios: list[float] = []
        for subject, maxima in self._learning.items():
            self.newcomer = [
                max(pair) for pair in zip(self.newcomer, maxima.highest(self._windows), strict=True)
            ]
            late = SubjectMaxima({block: counts for block, counts in maxima.blocks.items() if block >= early})
            self.highest[subject] = late.highest(self._windows)
            for block, counts in late.blocks.items():
                rest = late.highest(self._windows, without=block)
                ratios += [
                    (count - most) / (most + 1)
                    for count, most in zip(counts, rest, strict=True)
                    if count > most and most
                ]
        self.relative = sum(ratios) / len(ratios) if ratios else 0.0
        self._learning.clear()

    def nats(self, subject: Any, counts: tuple[float, ...]) -> tuple[float, int]:
        """Weigh counts.

        Args:
            subject: whose counts these are; unknown ones are compared with the highest of all subjects.
            counts: by window.

        Returns:
            The weight in nats, 0 if training saw as much; and the window that it comes from.
        """
        most = self._most(subject)
        best, which = 0.0, 0
        for number, (count, usual) in enumerate(zip(counts, most, strict=True)):
            if count > usual:
                share = max(self.relative, _LEAST_SHARE)
                weight = (count - usual) / max(self._least, share * usual)
                if weight > best:
                    best, which = weight, number
        return best, which

    def usual(self, subject: Any, window: int) -> float:
        """The highest count of training in a window."""
        return self._most(subject)[window]

    def _most(self, subject: Any) -> list[float]:
        own = self.highest.get(subject)
        if own is None:
            return self.newcomer
        return [max(count, _NEIGHBOURS_SHARE * most) for count, most in zip(own, self.newcomer, strict=True)]

    def to_state(self) -> dict[str, Any]:
        """Plain values for the model file."""
        return {
            "highest": [[subject, counts] for subject, counts in self.highest.items() if any(counts)],
            "newcomer": self.newcomer,
            "relative": self.relative,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """The inverse of `to_state`; subjects are lists there, tuples here.

        Raises:
            KeyError, TypeError, ValueError: the state is not one.
        """
        self.highest = {_frozen(subject): self._counts(counts) for subject, counts in state["highest"]}
        self.newcomer = self._counts(state["newcomer"])
        self.relative = float(state["relative"])

    def _counts(self, counts: Iterable[Any]) -> list[float]:
        found = [float(count) for count in counts]
        if len(found) != self._windows:
            raise ValueError(f"{len(found)} counts for {self._windows} windows")
        return found


def _frozen(subject: Any) -> Any:
    return tuple(map(_frozen, subject)) if isinstance(subject, list) else subject
