"""Progress of a switch's stream: sequence numbers, losses, capture time.

The switch numbers the frames that it copies or reports, in one sequence.  They arrive in two ordered
streams, packet-ins and digests.  A number is lost when all expected streams have passed it, or when the
silent one is far behind.

The switch's numbers have 32 bits and skip 0, which says that a frame has none; here they go on behind them.
"""

from itertools import pairwise
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from apps.packets import SteadyTime

Source = Literal["packet", "digest"]
WRAP: Final = 1 << 32
"""The switch's numbers are modulo this."""
_HALF: Final = WRAP // 2
_NEAR: Final = 1 << 24
"""A lower number is behind the wrap if it is less than this ahead; otherwise the switch has restarted."""
_STEP_US: Final = 3_600_000_000
_HORIZON: Final = 1 << 16
"""A stream that is this many numbers behind the other is not waited for."""


class LossTracker:
    """Counts of one switch."""

    def __init__(self) -> None:
        self.received = 0
        """Packet-ins."""
        self.reported = 0
        """Digests."""
        self.malformed = 0
        """Messages that do not fit the program; dropped."""
        self.restarts = 0
        """How often the numbers restarted."""
        self.arrival = 0
        """Arrival number of the newest frame seen."""
        self.time_us = 0
        """Capture time of the newest frame seen."""
        self.expected: frozenset[Source] = frozenset(("packet",))
        """Expected streams."""
        self.unaccounted = 0
        """Numbers between the last report of the controller before and the first to arrive here; at most so many are lost."""
        self._before: int | None = None
        """The last number that the controller before had reported."""
        self._first: int | None = None
        """The first number to arrive since this controller has the switch."""
        self._arrived = False
        self._clock = SteadyTime(_STEP_US)
        self._lost = 0
        self._passed: dict[Source, int] = {}
        self._gaps: list[tuple[int, int]] = []
        self._highest: int | None = None

    @property
    def lost(self) -> int:
        """Numbers that never arrived."""
        return self._lost

    @property
    def sequence(self) -> int:
        """The highest number that has arrived, as the switch wrote it; 0: none yet."""
        return (self._highest or 0) % WRAP

    def rest(self) -> None:
        """Another controller receives the packets from now on: what is missing here from then on is no loss."""
        self._settle(everything=True)
        self._passed.clear()
        self._highest = self._before = self._first = None

    def follow(self, sequence: int) -> None:
        """Go on behind another controller.

        Args:
            sequence: the highest number that it has reported.
        """
        self._before = sequence
        self._join()

    def _join(self) -> None:
        if self._before is not None and self._first is not None:
            missed = self._first - self._before - 1
            if missed < 0:  # behind the wrap, or the switch has restarted
                missed = missed % WRAP if missed % WRAP < _NEAR else 0
            self.unaccounted += missed
            self._before = None

    def expect_first(self) -> None:
        """The switch has just loaded its program: the next number is 1."""
        if self._highest is None:
            self._highest = 0

    def packets(
        self, sequence: NDArray[np.uint64], arrival: NDArray[np.uint64], time_us: NDArray[np.int64]
    ) -> None:
        """Record copied frames, in the order of their stream."""
        self.received += len(sequence)
        self._note("packet", sequence, arrival, time_us)

    def digests(
        self, sequence: NDArray[np.uint64], arrival: NDArray[np.uint64], time_us: NDArray[np.int64]
    ) -> None:
        """Record reported frames; a frame that was neither copied nor requested has number 0."""
        self.reported += len(sequence)
        self._note("digest", sequence, arrival, time_us)

    def passed(self, time_us: NDArray[np.int64]) -> None:
        """Record reports without numbers, at these capture times."""
        if len(time_us) and self._clock.hear(int(time_us[-1])):
            self.time_us = self._clock.now or 0

    @property
    def times_doubted(self) -> int:
        """Times that were too far from the previous ones."""
        return self._clock.doubted

    def _note(
        self,
        source: Source,
        sequence: NDArray[np.uint64],
        arrival: NDArray[np.uint64],
        time_us: NDArray[np.int64],
    ) -> None:
        numbers = sequence[sequence != 0].astype(np.int64)
        if len(numbers):
            self._count(source, numbers)
            self._arrive(int(arrival[-1]))
        # last: whoever reads the time, and then the number, takes no packet for handed on that is not
        self.passed(time_us)

    def _arrive(self, arrival: int) -> None:
        """The newest of both streams: a copy may come after digests of later frames."""
        if not self._arrived or (arrival - self.arrival) % WRAP < _HALF:
            self.arrival, self._arrived = arrival, True

    def _count(self, source: Source, numbers: NDArray[np.int64]) -> None:
        # after a break in both streams a lower first number means that the switch restarted
        near = unwrapped(int(numbers[0]), self._highest or 0) - 1
        first = self._highest if self._highest and not self._passed else near
        # a stream that was silent for long goes on where the other one is
        before = max(self._passed.get(source, first), near)
        steps, restarts = steps_ahead(numbers, before)
        start = 0
        for begin in np.flatnonzero(restarts).tolist():
            self._pass(source, before + np.cumsum(steps[start:begin]))
            self._begin_anew()
            start, before, steps[begin] = begin, 0, numbers[begin]
        self._pass(source, before + np.cumsum(steps[start:]))

    def _begin_anew(self) -> None:
        """A switch that counts from 1 again: the numbers before the first to arrive are lost, too."""
        self._settle(everything=True)
        self.restarts += 1
        self._arrived = False
        self._passed.clear()
        self._highest = 0

    def _pass(self, source: Source, numbers: NDArray[np.int64]) -> None:
        if not len(numbers):
            return
        if self._highest is None:
            self._highest = int(numbers[0]) - 1
        if self._first is None:
            self._first = int(numbers[0])
            self._join()
        highest = self._highest
        known = numbers[numbers <= highest]
        if len(known) and self._gaps:
            self._fill(known)
        fresh = numbers[len(known) :]
        if len(fresh):
            starts = np.concatenate(([highest], fresh[:-1]))
            for row in np.flatnonzero(fresh - starts > 1):
                self._gaps.append((int(starts[row]) + 1, int(fresh[row])))
            self._highest = int(fresh[-1])
        self._passed[source] = int(numbers[-1])
        self._settle()

    def _fill(self, numbers: NDArray[np.int64]) -> None:
        """Numbers that fill gaps of the other stream."""
        left: list[tuple[int, int]] = []
        for first, end in self._gaps:
            inside = numbers[(numbers >= first) & (numbers < end)].tolist()
            edges = [first - 1, *inside, end]
            left += [(a + 1, b) for a, b in pairwise(edges) if b - a > 1]
        self._gaps = left

    def _settle(self, *, everything: bool = False) -> None:
        """Gaps that can no longer be filled are losses."""
        if not self._gaps:
            return
        highest = self._highest or 0
        passed = min((self._passed.get(source, 0) for source in self.expected), default=highest)
        passed = max(passed, highest - _HORIZON)
        waiting = []
        for first, end in self._gaps:
            over = end if everything else min(end, passed + 1)
            self._lost += max(0, numbers_between(first, over))
            if max(first, over) < end:
                waiting.append((max(first, over), end))
        self._gaps = waiting


def steps_ahead(numbers: NDArray[np.int64], before: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """How far each of a stream's numbers is ahead of the one before it, and where the switch has restarted.

    Args:
        numbers: as the switch wrote them.
        before: the last number of the stream, which may have gone on behind the wrap.
    """
    steps = np.diff(numbers, prepend=before) & (WRAP - 1)  # as % WRAP, without a division for each
    lower = np.diff(numbers, prepend=before % WRAP) < 0
    return steps, (steps >= _HALF) | lower & (steps >= _NEAR)


def unwrapped(number: int, highest: int) -> int:
    """The first number of a stream, in the round of the other stream if it is near that one's highest."""
    ahead = (number - highest + _HALF) % WRAP - _HALF
    return highest + ahead if abs(ahead) < _NEAR and highest + ahead > 0 else number


def numbers_between(first: int, end: int) -> int:
    """How many numbers the switch gives from the first one up to the end."""
    return end - first - ((end - 1) // WRAP - (first - 1) // WRAP)
