"""What the adapter keeps ends at a number, however long it runs."""

import numpy as np

from apps.packets import PACKET_COLUMNS
from apps.sonata_adapter.evidence.auto_thresholds import AutoThresholds
from apps.sonata_adapter.keys import QUERY_PREFIX, request_of
from apps.sonata_adapter.planner.placement import SwitchLimits
from apps.sonata_adapter.planner.plan import plan
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.switch.reports import OVERFLOWS_KEPT, CountReportReader
from due import RecordBatch


def without_a_cell(time_us: int) -> RecordBatch:
    """One SYN whose destination has no cell in the switch."""
    columns = {name: np.zeros(1, kind) for name, kind in PACKET_COLUMNS.items()}
    columns |= {
        "time_us": np.array([time_us]),
        "ip_version": np.array([4], np.uint8),
        "ip_proto": np.array([6], np.int32),
        "ip_dst_lo": np.array([time_us % 65_536], np.uint64),
        "tcp_flags": np.array([2], np.uint8),
        "crossed": np.zeros(1, np.uint8),
        "overflow": np.ones(1, np.uint8),
    }
    return RecordBatch(columns)


def test_windows_without_a_result_are_forgotten_even_if_a_key_had_no_cell() -> None:
    """A busy switch lacks a cell now and then, and most windows have no result."""
    request = request_of(f"{QUERY_PREFIX}.new_tcp:threshold=5,window=3s", CATALOGUE)
    assert request is not None
    found = plan([request], SwitchLimits()).of(request.identity)
    reader = CountReportReader(request.query, found)
    for window in range(3 * OVERFLOWS_KEPT):
        assert reader.take(found.entries[0].bit, without_a_cell(window * 3_000_000)) == []
    assert (len(reader._overflows), reader.overflow) == (OVERFLOWS_KEPT, 3 * OVERFLOWS_KEPT)


def test_baselines_of_queries_that_nobody_wants_any_more_are_let_go() -> None:
    """The archive has them."""
    queries = AutoThresholds()
    for seconds in range(3, 13):
        assert not queries.want([f"{QUERY_PREFIX}.new_tcp:threshold=auto,window={seconds}s"], CATALOGUE)
    assert len(queries._kept) == 1
