"""Counts that the switch reports when their window is over go to whoever wants those of their query."""

import numpy as np
import pytest

from apps.p4runtime_ctrl.errors import P4InfoError
from apps.p4runtime_ctrl.southbound.counts_in import DIGEST, CountReader
from apps.p4runtime_ctrl.southbound.loss_tracker import LossTracker
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.values import canonical
from apps.p4runtime_ctrl.telemetry.demand import Offer, key_of
from p4rt import p4runtime
from sdnator.testing.product_program import program, without
from tests.apps.p4runtime_ctrl.southbound.test_digest_in import QUOTED, digest_list
from tests.apps.p4runtime_ctrl.test_packet_publisher import publisher

HOST = {"query": 3, "window": 8, "count": 5, "src": 0x0A000001, "timestamp": 9}
SIX = {
    "query": 200, "window": 1 << 31, "count": (1 << 32) - 2, "src": 0x20010DB8 << 96, "dst": 7, "port": 53,
    "length": 60, "source_port": 1000, "timestamp": 12,
}  # fmt: skip
COLUMNS = {
    "window": "uint32", "count": "int64", "src_hi": "uint64", "src_lo": "uint64", "dst_hi": "uint64",
    "dst_lo": "uint64", "port": "uint16", "length": "uint16", "source_port": "uint16", "time_us": "int64",
}  # fmt: skip


def count_list(*counts):
    found = p4runtime.DigestList(digest_id=program().digest_id(DIGEST))
    for count in counts:
        members = found.data.add().struct.members
        for name, _ in program().digest(DIGEST):
            members.add(bitstring=canonical(count.get(name, 0)))
    return found


def test_columns():
    progress = LossTracker()
    counts = CountReader(program(), 1000, progress).read([count_list(HOST), count_list(SIX, HOST)])
    batch = counts.of(200)
    assert {name: str(batch[name].dtype) for name in batch.columns} == COLUMNS
    assert [batch[name].tolist() for name in COLUMNS] == [
        [1 << 31], [-2], [0x20010DB8 << 32], [0], [0], [7], [53], [60], [1000], [1012],
    ]  # fmt: skip
    assert (counts.of(3)["count"].tolist(), len(counts.of(4)), len(counts)) == ([5, 5], 0, 3)
    assert (progress.time_us, progress.reported, progress.lost) == (1009, 0, 0)


def test_counts_go_to_who_wants_their_query():
    offers = {"q": Offer(name="q", bit=3, copy=False)}
    key = key_of("counts", "s1", "q")
    made, written = publisher(key, key_of("digests", "s1", "q"), offers=offers)
    made.digests([count_list(HOST, SIX), digest_list(QUOTED), count_list({**HOST, "timestamp": 20})])
    (_, frames, _), (name, counts, time_ns) = written
    assert frames["crossed"].tolist() == [1]
    assert (name, counts["time_us"].tolist(), time_ns) == (key, [1_000_009, 1_000_020], 1_000_020_000)
    assert (made.counts_reported, made.progress.reported, made.progress.time_us) == (3, 1, 1_000_020)


def test_counts_that_nobody_wants_are_counted_only():
    made, written = publisher()
    made.digests([count_list(HOST)])
    assert (written, made.counts_reported, made.second) == ([], 1, 1)


def test_a_program_without_this_digest_has_no_counts():
    assert CountReader(without(DIGEST), 0, LossTracker()).digest_id == 0


def test_a_digest_that_lacks_fields_is_refused():
    message = type(program().message)()
    message.CopyFrom(program().message)
    del message.type_info.structs[DIGEST].members[0]
    with pytest.raises(P4InfoError, match=f"{DIGEST} of the program lacks query"):
        CountReader(ProgramInfo(message), 0, LossTracker())


def test_no_counts_are_no_time():
    progress = LossTracker()
    progress.passed(np.array([], dtype=np.int64))
    assert progress.time_us == 0


def test_a_report_about_a_far_time_moves_no_clock():
    """Who asks what waits as of a far time is told with that time; the switch's own time stays what it was."""
    made, _ = publisher()
    made.digests([count_list(HOST)])
    for _ in range(9):
        made.digests([count_list({**HOST, "timestamp": 1 << 47})])
    assert made.second == 1
