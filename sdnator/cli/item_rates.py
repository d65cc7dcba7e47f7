"""Rates of items and records per second, and a sparkline of them.  Pure."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Final

SECONDS: Final = 60
_BLOCKS: Final = "▁▂▃▄▅▆▇█"


class Rates:
    """Counts by second of any clock; keeps the last minute."""

    def __init__(self, now: float) -> None:
        self._begin = now
        self._second = int(now)
        self._done: deque[int] = deque(maxlen=SECONDS)
        self._open = 0
        self.items = 0
        self.records = 0
        """Rows of record batches; any other item counts as one."""

    def add(self, value: Any) -> None:
        """Count an item within the second that `pass_time` set last."""
        count = len(value) if is_batch(value) else 1
        self.items += 1
        self.records += count
        self._open += count

    def pass_time(self, now: float) -> bool:
        """It is `now`; returns whether a second has ended."""
        ended = int(now) - self._second
        for _ in range(min(ended, SECONDS)):
            self._done.append(self._open)
            self._open = 0
        self._second += max(0, ended)
        return ended > 0

    @property
    def last(self) -> int:
        """Records of the last complete second."""
        return self._done[-1] if self._done else 0

    def mean(self, now: float) -> float:
        """Records per second since the start."""
        return self.records / max(now - self._begin, 1e-9)

    def line(self) -> str:
        """The last minute as blocks, the newest at the right."""
        return sparkline(list(self._done))


def is_batch(value: Any) -> bool:
    """Whether it is a record batch; recognised by its attributes, to avoid an import."""
    return hasattr(value, "columns") and hasattr(value, "__len__")


def sparkline(values: Sequence[float]) -> str:
    """One block for each value, its height from 0 to the largest; 0 is the lowest block."""
    top = max(values, default=0)
    if top <= 0:
        return _BLOCKS[0] * len(values)
    steps = len(_BLOCKS) - 1
    # a value above 0 is visible, however small
    return "".join(_BLOCKS[0 if value <= 0 else max(1, round(value / top * steps))] for value in values)


def headline(value: Any) -> str:
    """Summary of the newest item: the plain fields of a result."""
    if is_batch(value):
        return f"{len(value):,} records"
    if isinstance(value, Mapping):
        plain = {name: part for name, part in value.items() if isinstance(part, str | int | float)}
        hidden = ("window_start", "window_end", "at", "exact", "partial", "error")
        return "  ".join(f"{name} {part}" for name, part in plain.items() if name not in hidden)
    return str(value)
