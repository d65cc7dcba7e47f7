"""Which frames are new: the numbers of each (instance, key), and the epochs of each (app, path).

    begins where the last one ended      next: deliver
    begins later                         items are missing: count them, deliver
    … by more than FAR                   no outage loses that many: refuse
    begins earlier                       a repeat: drop
    … by more than KEPT                  no producer keeps that many for resending: the earlier number was false;
                                         deliver, and continue from here
    begins where a jump started          a producer never goes back, so the jump was false: deliver, too

The last rule applies until `CONFIRMED` frames have continued the numbers after the jump, and not to the first
jump after this instance was a standby: another one may have read the frames in between.
A restarted producer is a new instance, whose first frame may begin anywhere.

A frame with an older epoch than one seen from this app under this path is fenced off: its writer was replaced.
If the same instance wrote both, the higher epoch was false, because an instance's epoch never falls.

Frames carry no signature.  These rules keep a damaged or stray frame from displacing later ones; a program that
can write to the server and imitates an instance's numbers exactly can still replace a frame.
"""

import logging
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any

from due.codec import Frame
from due.errors import RefusedFrame

log = logging.getLogger("due")

FAR = 1 << 36
"""Items: 19 hours at a million a second."""
KEPT = 1 << 27
"""Items: over a gigabyte of the smallest."""
CONFIRMED = 64
_MOST_COUNTED = 1 << 62
_MOST_RANGES = 4096
"""Of one (instance, key), whose members take turns."""


class NumberRanges:
    """Disjoint ranges of numbers, ascending; the lowest are forgotten first.

    A member of a shared app sees only some frames of a producer, and a producer sends again whatever its readers may
    have missed, however long ago: a memory of single frames would have to hold them all.
    """

    __slots__ = ("_ends", "_starts")

    def __init__(self) -> None:
        self._starts: list[int] = []
        self._ends: list[int] = []

    @property
    def end(self) -> int:
        """Behind the highest number; 0: none yet."""
        return self._ends[-1] if self._ends else 0

    def add(self, first: int, end: int) -> bool:
        """Add `first` to `end`, not included; False if `first` was there already."""
        at = bisect_right(self._starts, first)
        if at and first < self._ends[at - 1]:
            return False
        if at and first == self._ends[at - 1]:
            at -= 1
            first = self._starts[at]
        after = at
        while after < len(self._starts) and self._starts[after] <= end:
            end = max(end, self._ends[after])
            after += 1
        self._starts[at:after], self._ends[at:after] = [first], [end]
        if len(self._starts) > _MOST_RANGES:
            del self._starts[0], self._ends[0]
        return True


class Tracker:
    """Per (instance, key): detects repeated frames and gaps."""

    def __init__(self, *, shared: bool, remember: int = 65536) -> None:
        self._shared = shared
        self._remember = remember
        self._expected: OrderedDict[tuple[str, str], int] = OrderedDict()
        self._left_off: OrderedDict[tuple[str, str], tuple[int, int]] = OrderedDict()
        """Where a jump started, and how many frames must still follow before it is accepted."""
        self._rested: set[tuple[str, str]] = set()
        self._seen: OrderedDict[tuple[str, str], NumberRanges] = OrderedDict()
        self._epochs: OrderedDict[tuple[str, str], tuple[int, str]] = OrderedDict()
        """The highest epoch, and the instance that wrote it."""
        self.gaps = 0
        """Items known to be missing."""
        self.repeats = 0
        """Repeated items that were dropped."""
        self.fenced = 0
        """Items of an instance that is no longer the active one."""
        self.refuted = 0
        """Numbers and epochs that later frames showed to be false."""

    def admit(self, frame: Frame, *, reliable: bool) -> bool:
        """Whether to deliver it; counts gaps, repeats and items of an older epoch.

        Raises `RefusedFrame` for a frame with impossible numbers.
        """
        count = len(frame.timestamps)
        if frame.epoch and not self._current(frame):
            self.fenced += count
            return False
        if reliable and self._shared:
            return self._unseen(frame, count)
        name = (frame.instance_id, frame.key)
        expected = self._expected.get(name)
        if expected is None:
            self._make_space(self._expected)
        elif frame.before != expected:
            if not self._moves(frame, name, expected):
                self.repeats += count
                return False
        elif self._left_off and name in self._left_off:
            self._confirm(name)
        self._expected[name] = frame.before + count
        return True

    def forget(self, keep: Callable[[str], bool]) -> None:
        """Forget keys without observers: items missed meanwhile are not a gap."""
        for name in [n for n in self._expected if not keep(n[1])]:
            del self._expected[name]
            self._left_off.pop(name, None)

    def place(self, path: str) -> dict[tuple[str, str], int]:
        """The number that comes next of each (instance, key) under a path."""
        return {name: number for name, number in self._expected.items() if _path_of(name[1]) == path}

    def resume(self, path: str, place: Mapping[tuple[str, str], int]) -> None:
        """Go on from a place: frames before it are repeats."""
        self.leave(path)
        for name, number in place.items():
            self._make_space(self._expected)
            self._expected[name] = number

    def leave(self, path: str) -> None:
        """Forget what was seen under a path: another instance reads it."""
        for name in [name for name in self._expected if _path_of(name[1]) == path]:
            del self._expected[name]
            self._left_off.pop(name, None)
            self._rested.discard(name)

    def rested(self) -> None:
        """This instance did not read for a while; another one of its app may have."""
        self._rested = set(self._expected)

    def _moves(self, frame: Frame, name: tuple[str, str], expected: int) -> bool:
        """Whether to deliver a frame that is not the next one."""
        jump = frame.before - expected
        left_off = self._left_off.get(name)
        if jump < -KEPT or (left_off is not None and frame.before == left_off[0]):
            self._left_off.pop(name, None)
            self._refute(f"{expected} items of {frame.key} were announced, {frame.before} were published")
            return True
        if jump < 0:
            return False
        if jump > FAR:
            raise RefusedFrame(
                "out_of_range",
                f"it says that {frame.before} items of {frame.key} came before it, {expected} were expected",
            )
        self._miss(frame, jump)
        if name in self._rested:
            self._rested.discard(name)
        elif left_off is None:
            self._make_space(self._left_off)
            self._left_off[name] = (expected, CONFIRMED)
        return True

    def _miss(self, frame: Frame, items: int) -> None:
        if not self.gaps:
            log.warning("%d items of %s are missing; further gaps are only counted", items, frame.key)
        self.gaps = min(self.gaps + items, _MOST_COUNTED)

    def _refute(self, what: str) -> None:
        self.refuted += 1
        if self.refuted == 1:
            log.error("an earlier frame had false numbers: %s; further ones are only counted", what)

    def _confirm(self, name: tuple[str, str]) -> None:
        place, frames = self._left_off[name]
        if frames > 1:
            self._left_off[name] = (place, frames - 1)
        else:
            del self._left_off[name]

    def _current(self, frame: Frame) -> bool:
        path = (frame.app_id, _path_of(frame.key))
        known = self._epochs.get(path)
        if known is None:
            self._make_space(self._epochs)
        elif frame.epoch == known[0]:
            return True
        elif frame.epoch < known[0]:
            if frame.instance_id != known[1]:
                return False
            if frame.before < self._reached((frame.instance_id, frame.key)):
                return True  # a resent older frame does not move the tracker
            self._refute(f"epoch {known[0]} of {frame.key}, its writer's is {frame.epoch}")
        self._epochs[path] = (frame.epoch, frame.instance_id)
        return True

    def _unseen(self, frame: Frame, count: int) -> bool:
        name = (frame.instance_id, frame.key)
        seen = self._seen.get(name)
        if seen is None:
            self._make_space(self._seen)
            seen = self._seen[name] = NumberRanges()
        if not seen.add(frame.before, frame.before + count):
            self.repeats += count
            return False
        return True

    def _reached(self, name: tuple[str, str]) -> int:
        seen = self._seen.get(name)
        return max(self._expected.get(name, 0), seen.end if seen is not None else 0)

    def _make_space(self, table: OrderedDict[Any, Any]) -> None:
        if len(table) >= self._remember:
            table.popitem(last=False)


def _path_of(key: str) -> str:
    return key.partition(":")[0]
