"""Packets as columns, and how they are collected, put in order and merged.

    Tape.add(time, **columns) … ─► Tape.traffic() ─► Traffic ─► merge(Traffic, Traffic …) ─► Traffic

Times within this package are µs since second 0 of a network; `time_us` of the columns is absolute.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from apps.packets import PACKET_COLUMNS

Array = npt.NDArray[Any]
Ints = npt.NDArray[np.int64]
Column = Array | int

SECOND: Final = 1_000_000
HOUR: Final = 3_600 * SECOND
BASE_US: Final = 1_772_445_600 * SECOND
"""Second 0 of every network, µs since the epoch: Monday, 2026-03-02, 10:00 UTC."""

_ABSENT: Final = {name: -1 if kind[0] == "i" else 0 for name, kind in PACKET_COLUMNS.items()}
_NUMBERS: Final = ("sequence", "arrival")


@dataclass(frozen=True, eq=False)
class Traffic:
    """Packets in order of time.

    `arrival` counts them from 0 and `sequence` from 1; a switch would number the frames of its ports so.
    """

    columns: dict[str, Array]
    """All of `apps.packets.PACKET_COLUMNS`, equally long."""
    attack: npt.NDArray[np.int32]
    """Id of the attack that sent the packet; 0: benign, and what victims answer."""

    def __len__(self) -> int:
        return len(self.attack)

    @property
    def first_us(self) -> int:
        """Absolute time of the first packet; 0 where there is none."""
        return int(self.columns["time_us"][0]) if len(self) else 0

    @property
    def last_us(self) -> int:
        """Absolute time of the last packet; 0 where there is none."""
        return int(self.columns["time_us"][-1]) if len(self) else 0

    def between(self, start_s: float, end_s: float) -> "Traffic":
        """The packets from `start_s` (included) to `end_s` (excluded), in seconds of the network; renumbered."""
        bounds = [BASE_US + round(edge * SECOND) for edge in (start_s, end_s)]
        first, last = np.searchsorted(self.columns["time_us"], bounds)
        return _numbered(
            {name: column[first:last] for name, column in self.columns.items()}, self.attack[first:last]
        )

    def batches(self, rows: int) -> Iterator["Traffic"]:
        """The same packets in parts of at most `rows`, numbered as here."""
        for start in range(0, len(self), rows):
            part = slice(start, start + rows)
            yield Traffic({name: column[part] for name, column in self.columns.items()}, self.attack[part])


EMPTY: Final = Traffic(
    {name: np.zeros(0, kind) for name, kind in PACKET_COLUMNS.items()}, np.zeros(0, np.int32)
)


def merge(*traffics: Traffic) -> Traffic:
    """All packets in order of time; of equal times those of the earlier argument come first.

    `arrival` and `sequence` are numbered anew.  Memory: the sum of the arguments, once more.
    """
    filled = [traffic for traffic in traffics if len(traffic)]
    if not filled:
        return EMPTY
    times = np.concatenate([traffic.columns["time_us"] for traffic in filled])
    order = np.argsort(times, kind="stable")
    columns = {
        name: np.concatenate([traffic.columns[name] for traffic in filled])[order] for name in PACKET_COLUMNS
    }
    return _numbered(columns, np.concatenate([traffic.attack for traffic in filled])[order])


def renumbered(traffic: Traffic, first: int) -> Traffic:
    """The same packets, `arrival` counted from `first`: for chunks of one stream."""
    return _numbered(traffic.columns, traffic.attack, first)


def _numbered(columns: Mapping[str, Array], attack: npt.NDArray[np.int32], first: int = 0) -> Traffic:
    arrival = np.arange(first, first + len(attack), dtype=np.uint64)
    return Traffic({**columns, "sequence": arrival + np.uint64(1), "arrival": arrival}, attack)


class Tape:
    """Packets in the order in which they were thought of; `traffic` puts them in order of time."""

    def __init__(self) -> None:
        self._times: list[Ints] = []
        self._parts: list[Mapping[str, Column]] = []
        self._attacks: list[Column] = []

    def add(self, time: Ints, *, attack: Column = 0, **columns: Column) -> None:
        """Packets at `time` (µs of the network); each column is one value, or one per packet."""
        if len(time):
            self._times.append(time)
            self._parts.append(columns)
            self._attacks.append(attack)

    def __len__(self) -> int:
        return sum(map(len, self._times))

    def traffic(self) -> Traffic:
        """Everything added, in order of time (of equal times in the order of adding)."""
        if not self._times:
            return EMPTY
        times = np.concatenate(self._times)
        order = np.argsort(times, kind="stable")
        ends = np.cumsum([len(time) for time in self._times])
        spans = [slice(end - len(time), end) for end, time in zip(ends, self._times, strict=True)]
        columns: dict[str, Array] = {"time_us": times[order] + BASE_US}
        for name, kind in PACKET_COLUMNS.items():
            if name in columns or name in _NUMBERS:
                continue
            column = np.full(len(times), _ABSENT[name], dtype=kind)
            for span, part in zip(spans, self._parts, strict=True):
                if name in part:
                    column[span] = part[name]
            columns[name] = column[order]
        attack = np.zeros(len(times), np.int32)
        for span, value in zip(spans, self._attacks, strict=True):
            attack[span] = value
        arrival = np.zeros(0, np.uint64)
        columns = {name: columns.get(name, arrival) for name in PACKET_COLUMNS}
        return _numbered(columns, attack[order])
