"""Digest lists of the counting stages → counts of keys whose difference is over its threshold.

The switch reports them when their window is over, with the key as in its cell, masked by the query.
Other programs may lack this digest; then there are no such counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.p4runtime_ctrl.errors import P4InfoError
from apps.p4runtime_ctrl.southbound.digest_rows import read_lists
from apps.p4runtime_ctrl.southbound.loss_tracker import LossTracker
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.rows import RowLayout
from due import RecordBatch

DIGEST: Final = "count_digest_t"
_NEEDED: Final = frozenset(
    ("query", "window", "count", "src", "dst", "port", "length", "source_port", "timestamp")
)
_STEP_US: Final = 3_600_000_000


@dataclass(frozen=True)
class CountReports:
    """Counts from digest lists, in their order."""

    columns: dict[str, NDArray[Any]]
    queries: NDArray[np.uint16]
    """Bit of the query that counted each key."""

    def __len__(self) -> int:
        return len(self.queries)

    def of(self, bit: int) -> RecordBatch:
        """The counts of one query: `window` (its number), `count` (may be negative), `src_hi`, `src_lo`,
        `dst_hi`, `dst_lo`, `port`, `length`, `source_port`, and `time_us` (absolute) of the report."""
        rows = self.queries == bit
        return RecordBatch({name: column[rows] for name, column in self.columns.items()})


class CountReader:
    """Reads the count digests of one switch and notes their time in `progress`.

    Raises `P4InfoError` if the program's digest lacks a field.
    """

    def __init__(self, program: ProgramInfo, base_us: int, progress: LossTracker) -> None:
        self.digest_id = program.digest_id(DIGEST)
        """0: the program reports no counts."""
        fields = program.digest(DIGEST) if self.digest_id else []
        missing = sorted(_NEEDED - {name for name, _ in fields})
        if self.digest_id and missing:
            raise P4InfoError(
                f"digest {DIGEST} of the program lacks {', '.join(missing)}; load the program of SDNator"
            )
        self._layout = RowLayout(fields)
        self._base_us = base_us
        self._progress = progress

    def read(self, lists: Sequence[Any]) -> CountReports:
        """All counts in the lists, which have `digest_id`."""
        found, malformed = read_lists(self._layout, lists)
        self._progress.malformed += malformed
        columns = _columns(found, self._base_us)
        self._progress.passed(self._near(columns["time_us"]))
        return CountReports(columns, found["query"].astype(np.uint16))

    def _near(self, times_us: NDArray[np.int64]) -> NDArray[np.int64]:
        """Times of the switch's own; a report that an app asked for as of a later time carries that time."""
        reached_us = self._progress.time_us
        return times_us[times_us <= reached_us + _STEP_US] if reached_us else times_us


def _columns(found: NDArray[Any], base_us: int) -> dict[str, NDArray[Any]]:
    return {
        "window": found["window"].astype(np.uint32),
        "count": found["count"].astype(np.uint32).view(np.int32).astype(np.int64),
        "src_hi": found["src"][:, 0].astype(np.uint64),
        "src_lo": found["src"][:, 1].astype(np.uint64),
        "dst_hi": found["dst"][:, 0].astype(np.uint64),
        "dst_lo": found["dst"][:, 1].astype(np.uint64),
        "port": found["port"].astype(np.uint16),
        "length": found["length"].astype(np.uint16),
        "source_port": found["source_port"].astype(np.uint16),
        "time_us": found["timestamp"].astype(np.int64) + base_us,
    }
