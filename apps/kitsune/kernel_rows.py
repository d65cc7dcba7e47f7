"""What the C trackers (senders, behaviour, victims) share: packet columns as pointers, numbers of switches, blocks.

A tracker takes a batch in one call and returns events: no Python object a packet.
"""

import ipaddress
import os
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from apps.kitsune.afterimage import CheckedColumns, seconds
from apps.kitsune.blocked import Blocked
from apps.kitsune.kernel import ROW_FIELDS, ColumnError, Columns, Kernel, array_type, contiguous
from apps.kitsune.names import ip_text, mac_text

WORDS: Final = 6
"""Numbers of 64 bits in a key of the tables."""
_ANY_SWITCH: Final = 0xFFFF
_LOW: Final = (1 << 64) - 1
_SIX: Final = 1 << 16
_VICTIM_SIX: Final = 1 << 17
_NAMES: Final = tuple(name for name, _, _ in ROW_FIELDS)
_KINDS: Final = tuple(kind for _, _, kind in ROW_FIELDS)
_TYPES: Final = tuple(map(np.dtype, _KINDS))
_NO_ROWS: Final = np.empty(0, np.int32)
_NANOSECONDS: Final = np.dtype("i8")
_POINTERS: Final = tuple(array_type(f"const {c_type}") for _, c_type, _ in ROW_FIELDS)
Address = tuple[int, int, int]


class RowRoom:
    """Memory for decoded packets that serves one batch after the other."""

    def __init__(self) -> None:
        self._count = -1
        self._held: tuple[Any, Any] = (None, None)

    def of(self, kernel: Kernel, count: int) -> tuple[Any, Any]:
        """Memory for so many packets, or more, and where they go in it."""
        if count > self._count:
            memory = np.empty(count * kernel.lib.row_bytes(), np.uint8)
            self._count = count
            self._held = memory, kernel.ffi.cast("Row *", kernel.ffi.from_buffer(memory))
        return self._held


class MarkedRoom:
    """Memory for SYNs that have their destination's address as sequence number; serves one batch after the other.

    Args:
        kernel: the C kernel.
        most: how many of a batch are looked at.
    """

    def __init__(self, kernel: Kernel, most: int) -> None:
        ffi = kernel.ffi
        self.most = most
        self.rows, self.by, self.senders = (ffi.new("int32_t[]", most) for _ in range(3))
        self.counts, self.times = ffi.new("int64_t[3]"), ffi.new("double[]", most)
        self.found = ffi.new("MarkedSender[]", most)


class MarkedSender(NamedTuple):
    """Who sent marked SYNs."""

    port: int
    mac: int
    address: int
    times: list[float]
    """Capture times, seconds; one that goes back is the one before it."""
    newest: float


class MarkedSyns(NamedTuple):
    """SYNs that have their destination's address as sequence number."""

    opening: int
    """SYNs of training, without ACK."""
    learnt: int
    """Those of them that are marked."""
    rows: npt.NDArray[np.int32]
    """Of the marked ones after training the first, as many as are looked at."""
    senders: list[MarkedSender]
    """In the order in which they come."""


class KernelRows(CheckedColumns):
    """A batch whose columns the trackers read; made once and handed to all of them.

    Args:
        kernel: the C kernel.
        batch: packet columns.
        room: where the decoded packets go until it is used again; None: memory of their own.

    Raises:
        ColumnError: a column is missing, no number, or of another length.
    """

    def __init__(self, kernel: Kernel, batch: Columns, room: RowRoom | None = None) -> None:
        self._kernel, self._batch = kernel, batch
        try:
            self.seconds = _seconds(kernel, batch)
            """Capture times."""
            kept = [self.seconds if name == "time" else batch[name] for name in _NAMES]
            if not _are_ready(kept):
                kept = list(map(contiguous, kept, _KINDS))
        except KeyError as error:
            raise ColumnError(f"the batch has no column {error}") from None
        shapes = {column.shape for column in kept}
        if len(shapes) != 1 or self.seconds.ndim != 1:
            raise ColumnError(f"columns of a batch are one-dimensional and equally long, not {shapes}")
        self._kept = kept
        self.count = len(self.seconds)
        ffi, lib = kernel
        self.pointer = ffi.new("PacketRows *", list(map(ffi.from_buffer, _POINTERS, kept)))
        self._memory, self.decoded = (room or RowRoom()).of(kernel, self.count)
        """The packets as the trackers read them."""
        lib.rows_read(self.pointer, self.count, self.decoded)

    def over(self, first: int, scores: npt.NDArray[np.float64], threshold: float) -> int:
        """How many packets from `first` on score at or above a threshold, or no number.

        Args:
            first: row.
            scores: of all rows, float64.
            threshold: a score.
        """
        kernel = self._kernel
        found: int = kernel.lib.scores_over(kernel.pointer("double", scores), first, self.count, threshold)
        return found

    def benign(
        self, first: int, scores: npt.NDArray[np.float64], threshold: float, macs: npt.NDArray[np.uint64]
    ) -> tuple[int, int, float, float]:
        """Of packets from `first` on that neither come from one of some MACs nor go to one: how many there are, how many
        score above a threshold, the first and the last time (no number where one is none).

        Args:
            first: row.
            scores: of all rows, float64.
            threshold: a score.
            macs: ascending.
        """
        kernel = self._kernel
        found = kernel.ffi.new("double[3]")
        given = kernel.pointer("double", scores), threshold, kernel.pointer("uint64_t", macs), len(macs)
        count = kernel.lib.rows_benign(self.decoded, first, self.count, *given, found)
        return count, int(found[0]), found[1], found[2]

    def marked(self, trained: int, room: MarkedRoom) -> MarkedSyns:
        """SYNs of IPv4 whose sequence number (`tcp_seq`) is the address of their destination.

        Args:
            trained: packets at the beginning that belong to training; of those such SYNs are only counted.
            room: for as many of the others as are looked at.

        Raises:
            ColumnError: the sequence numbers are no column of this batch.
        """
        kernel, sequence = self._kernel, contiguous(self._batch["tcp_seq"], "u4")
        if sequence.shape != self.seconds.shape:
            raise ColumnError(f"tcp_seq has the shape {sequence.shape}, other columns {self.seconds.shape}")
        found = room.rows, room.by, room.senders, room.counts
        count = kernel.lib.rows_marked(
            self.pointer, kernel.pointer("uint32_t", sequence), self.count, trained, room.most, *found
        )
        opening, learnt, senders = room.counts
        if not count:
            return MarkedSyns(opening, learnt, _NO_ROWS, [])
        rows = np.frombuffer(kernel.ffi.buffer(room.rows, count * _NO_ROWS.itemsize), _NO_ROWS.dtype)
        return MarkedSyns(opening, learnt, rows, self._marked_senders(count, senders, room))

    def _marked_senders(self, count: int, senders: int, room: MarkedRoom) -> list[MarkedSender]:
        (ffi, lib), times = self._kernel, contiguous(self._batch["time_us"], "i8")
        if times.shape != self.seconds.shape:
            raise ColumnError(f"time_us has the shape {times.shape}, other columns {self.seconds.shape}")
        given = self._kernel.pointer("int64_t", times), count, room.rows, room.by, senders, room.senders
        lib.marked_senders(self.pointer, *given, room.found, room.times)
        return [
            MarkedSender(
                who.port, who.mac, who.source, ffi.unpack(room.times + who.first, who.count), who.newest
            )
            for who in room.found[0:senders]
        ]

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        # every reader asks for seconds first
        return self.seconds if name == "time_s" else self._batch[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._batch)

    def __len__(self) -> int:
        return len(self._batch)


def _are_ready(columns: Sequence[Any]) -> bool:
    """Whether `contiguous` would return each column as it is, which is what it does with those of a message."""
    for column, dtype in zip(columns, _TYPES, strict=True):
        if type(column) is not np.ndarray or column.dtype is not dtype:
            return False
        flags = column.flags
        if not (flags.c_contiguous and flags.aligned):
            return False
    return True


def _seconds(kernel: Kernel, batch: Columns) -> npt.NDArray[np.float64]:
    """As `seconds`; by C for the times of a message."""
    if "time_s" in batch or "time_ns" not in batch:
        return seconds(batch)
    times = batch["time_ns"]
    if type(times) is not np.ndarray or times.dtype is not _NANOSECONDS or times.ndim != 1:
        return seconds(batch)
    times = contiguous(times, "i8")
    found = np.empty(len(times))
    kernel.lib.seconds_of(kernel.pointer("int64_t", times), len(times), kernel.pointer("double", found))
    return found


def rows_of(kernel: Kernel, batch: Columns) -> KernelRows:
    """The batch as it is, if it was made ready before."""
    return batch if isinstance(batch, KernelRows) else KernelRows(kernel, batch)


def check(failed: int, what: str) -> None:
    """Turn a code of the C interface into an exception."""
    if failed == -1:
        raise MemoryError(f"{what}: no memory for another entry")
    if failed:
        raise ColumnError(f"{what}: the numbers handed over contradict each other")


def seed() -> int:
    """For hashing, so that nobody can choose keys that collide."""
    return int.from_bytes(os.urandom(8), "little")


def events_in(kernel: Kernel, dtype: np.dtype[np.void], pointer: Any, count: int) -> list[tuple[Any, ...]]:
    """Events of a tracker as tuples in the order of the fields."""
    if not count:
        return []
    data = kernel.ffi.buffer(pointer, count * dtype.itemsize)
    found: list[tuple[Any, ...]] = np.frombuffer(data, dtype).tolist()
    return found


class SwitchNumbers:
    """Short numbers for the names of switches, and which blocks concern them."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self._numbers: dict[str, int] = {}
        self._applied = (0, 0)

    def number(self, name: str) -> int:
        """The number of a switch, a new one for a new name."""
        found = self._numbers.get(name)
        if found is None:
            if len(self.names) >= _ANY_SWITCH:
                raise ValueError(f"more than {_ANY_SWITCH:,} switches")
            found = self._numbers[name] = len(self.names)
            self.names.append(name)
        return found

    def changed_blocks(self, blocked: Blocked) -> npt.NDArray[np.uint64] | None:
        """Rows of number, is MAC, version and two halves, if they differ from those of the last call."""
        state = (blocked.changes, len(self.names))
        if state == self._applied or (not blocked.changes and not self._applied[0]):
            return None
        self._applied = state
        rows = []
        for switch, text in blocked.targets:
            number = _ANY_SWITCH if switch == "*" else self._numbers.get(switch)
            target = _target(text)
            if number is not None and target is not None:
                rows.append((number, *target))
        return np.array(rows, dtype=np.uint64).reshape(-1, 5)


@lru_cache(maxsize=65_536)
def _target(text: str) -> tuple[int, int, int, int] | None:
    """Whether it is a MAC, IP version and two halves; None for what is the name of no sender."""
    try:
        parsed = ipaddress.ip_address(text)
    except ValueError:
        try:
            mac = int(text.replace(":", ""), 16)
            return (1, 0, 0, mac) if mac_text(mac) == text else None
        except (ValueError, OverflowError):
            return None
    whole = int(parsed)
    found = (0, parsed.version, whole >> 64, whole & _LOW)
    return found if ip_text(*found[1:]) == text else None


def sender_words(number: int, port: int, mac: int, address: Address, more: int = 0) -> tuple[int, ...]:
    """The key of a sender, as `sender_of` in C makes it."""
    version, hi, lo = address
    return (mac | port << 48, number | (version == 6) * _SIX | more << 32, hi, lo, 0, 0)


def sender_parts(words: Sequence[int]) -> tuple[int, int, int, Address]:
    """Number of the switch, port, MAC and address (version 4 where there is none); the inverse of `sender_words`."""
    first, second, hi, lo = words[:4]
    return second & 0xFFFF, first >> 48, first & (1 << 48) - 1, (6 if second & _SIX else 4, hi, lo)


def victim_version(words: Sequence[int]) -> int:
    """IP version of the victim of an event."""
    return 6 if words[1] & _VICTIM_SIX else 4
