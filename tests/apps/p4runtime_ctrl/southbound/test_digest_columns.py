"""Columns that C makes of digests are those of numpy, whatever the digests hold."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from apps.p4runtime_ctrl.southbound.digest_columns import FIELDS, DigestColumns
from apps.p4runtime_ctrl.southbound.digest_in import FRAME_DIGEST, columns_of
from apps.p4runtime_ctrl.southbound.rows import RowLayout
from apps.p4runtime_ctrl.telemetry.coverage import uncovered
from sdnator.testing.product_program import program

LAYOUT = RowLayout(program().digest(FRAME_DIGEST))
COLUMNS = DigestColumns.of(LAYOUT)
WIDTHS = dict(program().digest(FRAME_DIGEST))
USUAL = {
    "ethertype": (0x0800, 0x86DD, 0x0806, 0x9100, 0x0042, 0x05FF, 0x0600),
    "protocol": (1, 6, 17, 58),
    "quoted_protocol": (6, 17),
    "arp_operation": (0, 1, 2),
}


@st.composite
def frames(draw):
    """A digest's members: usual numbers, any numbers, and the largest."""
    found = {}
    for name, bits in WIDTHS.items():
        most = (1 << bits) - 1
        numbers = st.one_of(st.integers(0, most), st.just(most), st.just(0))
        found[name] = draw(st.one_of(st.sampled_from(USUAL[name]), numbers) if name in USUAL else numbers)
    return found


def rows_of(many):
    values = [
        [frame[name].to_bytes(width, "big") for name, width in zip(WIDTHS, LAYOUT.widths, strict=True)]
        for frame in many
    ]
    return LAYOUT.array(values)


@given(st.lists(frames(), max_size=12), st.integers(0, 2_000_000_000_000_000))
def test_columns_are_those_of_numpy(many, base_us):
    rows = rows_of(many)
    columns, covered = COLUMNS.read(rows, base_us)
    expected = columns_of(rows, base_us)
    assert list(columns) == list(expected)
    for name, column in expected.items():
        assert columns[name].dtype == column.dtype, name
        assert columns[name].tolist() == column.tolist(), name
    assert covered.tolist() == (~uncovered(rows)).tolist()


def test_rows_may_lie_apart():
    rows = rows_of([dict.fromkeys(WIDTHS, number) for number in (1, 0, 1, 0)])[::2]
    columns, _ = COLUMNS.read(rows, 5)
    assert columns["time_us"].tolist() == [6, 6]
    assert columns["arrival"].tolist() == [1, 1]


def test_fields_of_other_widths_are_left_to_numpy():
    for name, width in (("src", 32), ("sport", 200)):
        odd = RowLayout([(each, width if each == name else WIDTHS[each]) for each in FIELDS])
        assert DigestColumns.of(odd) is None


def test_without_a_library_it_does_not_work(monkeypatch):
    place = "apps.p4runtime_ctrl.southbound.digest_columns.load_digest_rows"
    monkeypatch.setattr(place, lambda: None)
    assert DigestColumns.of(LAYOUT) is None


def test_no_frames_give_no_rows():
    columns, covered = COLUMNS.read(LAYOUT.array([]), 0)
    assert {len(column) for column in columns.values()} == {0} == {len(covered)}
    assert columns["arrival"].dtype == np.uint64
