"""AfterImage: 100 damped statistics that describe each packet in its context.

    columns   0- 14  packets of the sender's MAC and IP      weight, mean, variance
    columns  15- 49  packets from host to host               the same, and radius, magnitude, covariance, pcc
    columns  50- 64  time between packets of the two hosts   weight, mean, variance
    columns  65- 99  packets from socket to socket           as from host to host

Each group holds five time scales: the damping factors 5, 3, 1, 0.1 and 0.01 per second, in this
order.  Reference mode equals the published implementation bit for bit (x86-64, glibc with FMA).

Bounded mode, measured against it: on the 38,363 real packets 9 cells of 3.8 million differ and no score
by more than 2e-11; on three generated infections the AUC agrees to six digits and all alerts are the
same.  Where dozens of hosts all talk to each other, covariances differ visibly, the rest in rounding.
"""

import sys
from collections.abc import Mapping
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from apps.kitsune.kernel import PACKET_FIELDS, ColumnError, Columns, Kernel, contiguous, load_kernel

WIDTH: Final = 100
_TOO_SHORT: Final = -2
Mode = Literal["reference", "bounded"]

MAX_STREAMS: Final = 65_536
MAX_LINKS: Final = 65_536
STREAMS_PER_LOG: Final = 128
"""A table has at most one log of a hub for so many streams, of 32 KiB each; as in `afterimage_hubs.h`."""
HORIZON_S: Final = 3_000.0
"""After this idle time a stream's weight at the slowest scale is below 1e-9."""

_ROOMS: Final = 2
"""The features of the last batch are often still in use when those of the next are computed."""
_KEPT_ROWS: Final = 16_384
"""Memory for more packets is not kept."""
_UNUSED: Final = 2


class CheckedColumns(Mapping[str, npt.NDArray[Any]]):
    """A batch whose columns fit each other and are what the kernel reads."""

    pointer: Any
    """Its columns in C, beginning with those of `PACKET_FIELDS`."""
    count: int
    """Packets."""


class FeatureRoom:
    """Memory for features, used again once nobody holds the features that were there.

    New memory costs a page fault for every five packets: in large batches a twentieth of the detector's time.
    """

    def __init__(self) -> None:
        self._kept = [np.empty((0, WIDTH)) for _ in range(_ROOMS)]

    def of(self, count: int) -> npt.NDArray[np.float64]:
        """Memory for the features of so many packets."""
        if count > _KEPT_ROWS:
            return np.empty((count, WIDTH))
        for number in range(_ROOMS):
            # whoever has features refers to it; so do the list and the argument
            if sys.getrefcount(self._kept[number]) == _UNUSED:
                if len(self._kept[number]) < count:
                    self._kept[number] = np.empty((count, WIDTH))
                return self._kept[number][:count]
        return np.empty((count, WIDTH))


class AfterImage:
    """Turns record batches into rows of features; the state grows with the traffic seen.

    Args:
        mode: "reference" is exact and unbounded, as published.  "bounded" holds at most `max_streams`
            and `max_links` in each of its tables, forgets streams idle for `horizon` seconds, and its
            cost per packet does not grow with the number of a host's peers.  Its clock never runs
            backwards.  Features differ in rounding where a host has missed many packets of a busy
            peer, and in covariance where two hosts each talk to many busy ones.
        kernel: None loads the one that was built.
    """

    def __init__(
        self,
        mode: Mode = "reference",
        *,
        max_streams: int = MAX_STREAMS,
        max_links: int = MAX_LINKS,
        horizon: float = HORIZON_S,
        kernel: Kernel | None = None,
    ) -> None:
        if max_streams < 2 or max_links < 1:
            raise ValueError(f"max_streams={max_streams}, max_links={max_links}: must be at least 2 and 1")
        self._engine = _KernelEngine(
            kernel or load_kernel(), mode == "bounded", max_streams, max_links, horizon
        )

    def update(self, batch: Columns, room: FeatureRoom | None = None) -> npt.NDArray[np.float64]:
        """Features of each packet of the batch, in order: float64, shape (packets, 100).

        Args:
            batch: packet columns, in capture order.
            room: where the features go; None: new memory.

        Raises `ColumnError` for columns that are missing, of other lengths, or no numbers; `MemoryError`
        when the state cannot grow: the object is not usable afterwards.
        """
        columns = batch if isinstance(batch, CheckedColumns) else _columns(batch)
        count = columns.count if isinstance(columns, CheckedColumns) else len(columns["time"])
        out = np.empty((count, WIDTH)) if room is None else room.of(count)
        if count:
            self._engine.update(columns, out)
        return out

    @property
    def counts(self) -> dict[str, int]:
        """Streams and links held, streams dropped for age, cells dropped for lack of room, logs of hubs."""
        names = ("streams", "links", "forgotten_idle", "forgotten_full", "hub_logs")
        return dict(zip(names, self._engine.counts(), strict=True))


def _columns(batch: Columns) -> dict[str, npt.NDArray[Any]]:
    """The columns that the kernel reads, checked for equal length."""
    try:
        found = {name: contiguous(batch[name], kind) for name, _, kind in PACKET_FIELDS if name != "time"}
        found["time"] = seconds(batch)
    except KeyError as error:
        raise ColumnError(f"the batch has no column {error}") from None
    shapes = {name: column.shape for name, column in found.items()}
    if len(set(shapes.values())) != 1 or found["time"].ndim != 1:
        raise ColumnError(f"columns of a batch are one-dimensional and equally long, not {shapes}")
    return found


def seconds(batch: Columns) -> npt.NDArray[np.float64]:
    """Capture time in seconds, the float64 nearest to the capture's decimal.

    Taken from `time_s` (float64) or `time_ns` where a batch has one, else from `time_us`.
    """
    if "time_s" in batch:
        return contiguous(batch["time_s"], "f8")
    if "time_ns" in batch:
        whole, rest = np.divmod(batch["time_ns"], 1_000_000_000)
        return contiguous(whole + rest / 1e9, "f8")
    return contiguous(batch["time_us"] / 1e6, "f8")


class _KernelEngine:
    def __init__(
        self, kernel: Kernel, bounded: bool, max_streams: int, max_links: int, horizon: float
    ) -> None:
        state = kernel.lib.afterimage_new(bounded, max_streams, max_links, horizon)
        if state == kernel.ffi.NULL:
            raise MemoryError("AfterImage: no memory for its tables")
        self._kernel = kernel
        self._state = kernel.ffi.gc(state, kernel.lib.afterimage_free)

    def update(self, columns: Columns, out: npt.NDArray[np.float64]) -> None:
        kernel = self._kernel
        if isinstance(columns, CheckedColumns):
            struct = kernel.ffi.cast("Columns *", columns.pointer)
            lengths = kernel.ffi.new("long[]", [columns.count] * len(PACKET_FIELDS))
        else:
            struct = kernel.ffi.new("Columns *")
            for name, c_type, _ in PACKET_FIELDS:
                setattr(struct, name, kernel.pointer(f"const {c_type}", columns[name]))
            lengths = kernel.ffi.new("long[]", [len(columns[name]) for name, _, _ in PACKET_FIELDS])
        features = kernel.pointer("double", out)
        failed = kernel.lib.afterimage_update(self._state, struct, lengths, len(out), features, out.size)
        if failed == _TOO_SHORT:
            raise ColumnError("columns of a batch are equally long")
        if failed:
            raise MemoryError("AfterImage: no memory for another stream or link; use mode='bounded'")

    def counts(self) -> tuple[int, ...]:
        numbers = np.zeros(5, dtype=np.uint64)
        self._kernel.lib.afterimage_counts(self._state, self._kernel.pointer("uint64_t", numbers))
        return tuple(int(number) for number in numbers)
