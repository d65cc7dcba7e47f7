"""Gates: which packets of a window come after enough others of their key.

A batch may say of packets that they have passed a gate in the switch (`PASSED`); these pass, and do not count here,
where the packets that opened it have not come.
"""

from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.host.key_tables import Growing, KeyTable
from apps.sonata_adapter.host.operators import filtered
from apps.sonata_adapter.query.dataflow import conjuncts
from apps.sonata_adapter.query.expressions import PAYLOAD_FIELDS, Expression, fields_of
from apps.sonata_adapter.query.language import Gate
from due import RecordBatch

PASSED: Final = "passed"
"""Column of a batch: whether the packet passed the gate in the switch."""
_OPEN: Final = -1


class GateOperator:
    """One gate in one window."""

    def __init__(self, gate: Gate, limit: int) -> None:
        self._gate = gate
        self._conditions = conjuncts(gate.condition)
        self._keys = KeyTable(limit)
        self._limit = limit
        self._counts = Growing(np.int64)
        self._opened = Growing(np.int64)
        """By number of the key: one more than the row of this batch that opened it; 0: closed; -1: open before."""
        self._taken: PacketColumns | None = None
        self._new: NDArray[np.intp] = np.empty(0, dtype=np.intp)
        self.beyond = 0

    def passed(self, packets: PacketColumns, rows: PacketColumns, key: Expression) -> PacketColumns:
        """Those of `rows`, which are some of `packets`, that come after the gate of their key has opened.

        Args:
            packets: all packets of the window that came together; each is counted once.
            rows: some of them.
            key: their field that goes through the gate.
        """
        if packets is not self._taken:
            self._count(packets)
        if not len(rows):
            return rows
        numbers = self._number(rows, key)
        opened = np.where(numbers < 0, _OPEN, self._opened.data[numbers])
        kept = (opened < 0) | ((opened > 0) & (opened <= rows.origin + 1))
        marked = rows.marks(PASSED)
        if marked is not None:
            kept |= marked
        return rows if kept.all() else rows.at(np.flatnonzero(kept))

    def _number(self, rows: PacketColumns, key: Expression) -> NDArray[np.int64]:
        numbers, _ = self._keys.number(rows.keys((key,)))
        self._counts.extend(self._keys.size)
        self._opened.extend(self._keys.size)
        return numbers

    def _count(self, packets: PacketColumns) -> None:
        self._taken = packets
        self._opened.data[self._new] = _OPEN
        self._new = self._new[:0]
        rows: PacketColumns = filtered(packets, self._conditions)  # type: ignore[assignment]
        marked = rows.marks(PASSED)
        if marked is not None:
            rows = rows.at(np.flatnonzero(~marked))
        if not len(rows):
            return
        numbers = self._number(rows, self._gate.key)
        placed = np.flatnonzero(numbers >= 0)
        self.beyond += len(numbers) - len(placed)
        order = placed[np.argsort(numbers[placed], kind="stable")]
        ordered = numbers[order]
        begins = np.flatnonzero(np.diff(ordered, prepend=-1))
        sizes = np.diff(begins, append=len(ordered))
        missing = self._gate.count - self._counts.data[ordered[begins]]
        opens = (missing > 0) & (missing <= sizes)
        self._new = ordered[begins[opens]].astype(np.intp)
        self._opened.data[self._new] = rows.origin[order[begins[opens] + missing[opens] - 1]] + 1
        self._counts.data[ordered[begins]] += sizes

    @property
    def error(self) -> str:
        """Why what passes is an estimate; empty: it is exact."""
        if not self.beyond:
            return ""
        return f"gate: {self.beyond} packets of keys beyond the bound of {self._limit}, all of which pass"


def split_by_payload(
    conditions: Iterable[Expression],
) -> tuple[tuple[Expression, ...], tuple[Expression, ...]]:
    """Conditions on headers, and those that read payloads: these are better looked at behind a gate."""
    headers: list[Expression] = []
    payloads: list[Expression] = []
    for each in conditions:
        reads = set(fields_of(each)) & (PAYLOAD_FIELDS | {"payload"})
        (payloads if reads else headers).append(each)
    return tuple(headers), tuple(payloads)


def with_passed(batch: RecordBatch, *, passed: bool) -> RecordBatch:
    """The batch, marked as packets that have passed their gate in the switch, or not."""
    return RecordBatch({**batch, PASSED: np.full(len(batch), passed)})
