"""Which packets come after the result of their window, known before the windows are worked on.  Pure.

The host engine closes a window when an item has taken time far enough, and leaves out what later items bring for that
window or an older one.  Both follow from few numbers for each window, which workers find in any order:

    first item that has a packet of it ─┐
    first item that could close it     ─┴─► the item with which it is closed ─► `Closings.late`
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.host.archive_columns import ITEM, KEY, ROW, TIME, numbers, switch_of

CLOCKS: Final = "switch string, kind int, number bigint, item bigint, time bigint, packets bigint"
"""Spark's schema of what `clock_rows` yields."""
_KINDS: Final = range(3)
BEGINS, CLOSES, STARTS = _KINDS
"""Kinds of its rows: first item of a window, first item that closes windows up to one, first row of a switch."""
_NEVER: Final = np.iinfo(np.int64).max
_Numbers = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class WindowClock:
    """How windows follow from times."""

    length_us: int
    lateness_us: int
    """How long after its end a window waits for late packets."""
    bases: dict[str, int]
    """Switch to absolute time of its clock zero, us."""

    def windows(self, switch: str, times: _Numbers) -> _Numbers:
        """The number of each packet's window."""
        return (times - self.bases[switch]) // self.length_us

    def closed_by(self, switch: str, times: _Numbers) -> _Numbers:
        """The number of the last window that is over at each time."""
        return (times - self.bases[switch] - self.lateness_us) // self.length_us - 1


class ClockRow(NamedTuple):
    """The least of one number, over all of the archive."""

    switch: str
    kind: int
    number: int
    item: int
    time: int
    packets: int


def clock_rows(batches: Iterable[Any], clock: WindowClock) -> Iterator[Any]:
    """Arrow batches with `CLOCK_SCHEMA` to Arrow batches of `CLOCKS`, each the least of its own."""
    pa: Any = import_module("pyarrow")

    for batch in batches:
        rows = [row for part in by_switch(batch) for row in _of_switch(batch, *part, clock)]
        columns: list[Any] = list(zip(*rows, strict=True)) or [()] * len(ClockRow._fields)
        kinds = (pa.string(), pa.int32(), *(pa.int64(),) * 4)
        arrays = [pa.array(column, kind) for column, kind in zip(columns, kinds, strict=True)]
        yield pa.RecordBatch.from_arrays(arrays, names=list(ClockRow._fields))


def by_switch(batch: Any) -> Iterator[tuple[str, NDArray[np.intp]]]:
    """Each switch in an Arrow batch of packets, and its rows."""
    codes = batch.column(KEY).dictionary_encode()
    switches = [switch_of(key) for key in codes.dictionary.to_pylist()]
    found = codes.indices.to_numpy(zero_copy_only=False)
    for switch in sorted(set(switches)):
        among = [code for code, name in enumerate(switches) if name == switch]
        (rows,) = np.isin(found, among).nonzero()
        yield switch, rows


def _of_switch(batch: Any, switch: str, rows: NDArray[np.intp], clock: WindowClock) -> Iterator[ClockRow]:
    times, items, places = (numbers(batch, name)[rows] for name in (TIME, ITEM, ROW))
    for kind, windows in (
        (BEGINS, clock.windows(switch, times)),
        (CLOSES, clock.closed_by(switch, times)),
    ):
        for number, item in zip(*_least(windows, items), strict=True):
            yield ClockRow(switch, kind, number, item, 0, 0)
    at = int(places.argmin())
    yield ClockRow(switch, STARTS, 0, int(places[at]), int(times[at]), len(rows))


def _least(groups: _Numbers, values: _Numbers) -> tuple[list[int], list[int]]:
    """The least value of each group."""
    order = np.lexsort((values, groups))
    found, first = np.unique(groups[order], return_index=True)
    return found.tolist(), values[order][first].tolist()


class Closings:
    """With which item each window of a switch is closed.

    Args:
        windows: numbers of the windows that have packets, shape (n,).
        begins: the first item of each, shape (n,).
        over: numbers of windows, shape (m,).
        closes: the first item by which each of those is over, shape (m,).
    """

    def __init__(self, windows: _Numbers, begins: _Numbers, over: _Numbers, closes: _Numbers) -> None:
        self._windows, begins = _sorted(windows, begins)
        over, closes = _sorted(over, closes)
        # an item closes all windows up to its own
        earliest = np.append(_least_from_here(closes), _NEVER)
        closed = np.maximum(begins, earliest[np.searchsorted(over, self._windows)])
        # and a window that is closed closes those before it to late packets
        self._items = _least_from_here(closed)

    def late(self, windows: _Numbers, items: _Numbers) -> NDArray[np.bool_]:
        """Which packets come too late.

        Args:
            windows: number of the window of each.
            items: number of the item of each.
        """
        found: NDArray[np.bool_] = items > self._items[np.searchsorted(self._windows, windows)]
        return found


def closings_of(table: Any) -> tuple[dict[str, Closings], dict[str, ClockRow]]:
    """What follows from the least of all `clock_rows`.

    Args:
        table: of Arrow, with the columns of `CLOCKS`, and one row for each switch, kind and number.

    Returns:
        By switch: when its windows are closed, and where its packets begin.
    """
    codes = table["switch"].combine_chunks().dictionary_encode()
    places = codes.indices.to_numpy(zero_copy_only=False)
    kinds, numbers, items = (table[name].to_numpy() for name in ("kind", "number", "item"))
    closings, starts = {}, {}
    for code, switch in enumerate(codes.dictionary.to_pylist()):
        begins, closes, start = (((places == code) & (kinds == kind)).nonzero()[0] for kind in _KINDS)
        closings[switch] = Closings(numbers[begins], items[begins], numbers[closes], items[closes])
        starts[switch] = ClockRow(*(table[name][int(start[0])].as_py() for name in ClockRow._fields))
    return closings, starts


def _sorted(keys: _Numbers, values: _Numbers) -> tuple[_Numbers, _Numbers]:
    order = np.argsort(keys)
    return keys[order], values[order]


def _least_from_here(values: _Numbers) -> _Numbers:
    """For each place the least value from there to the end."""
    return np.minimum.accumulate(values[::-1])[::-1]
