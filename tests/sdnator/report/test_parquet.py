"""Tables written as Parquet can be read again: structure checked here, content by pyarrow where it is installed."""

import struct

import numpy as np
import pytest

from sdnator.report.parquet import write_parquet

COLUMNS = {
    "index": np.arange(5, dtype=np.int64),
    "small": np.arange(5, dtype=np.int32) - 2,
    "score": np.array([0.0, -1.5, np.nan, np.inf, 1e300]),
    "state": np.array(["train", "scored", "", "ä", "x" * 300]),
}


def test_begins_and_ends_as_the_format_says(tmp_path):
    write_parquet(tmp_path / "t.parquet", COLUMNS)
    data = (tmp_path / "t.parquet").read_bytes()
    (footer,) = struct.unpack("<I", data[-8:-4])
    assert data[:4] == data[-4:] == b"PAR1"
    assert 0 < footer < len(data) - 12
    assert COLUMNS["score"].tobytes() in data


def test_pyarrow_reads_the_same(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    many = {f"column{number}": np.arange(3.0) for number in range(20)}
    for name, columns in (("few", COLUMNS), ("many", many), ("none", {"a": np.zeros(0)})):
        write_parquet(tmp_path / name, columns)
        table = parquet.read_table(tmp_path / name)
        assert table.column_names == list(columns)
        for column, values in columns.items():
            assert str(table[column].to_pylist()) == str(values.tolist())


def test_what_does_not_fit_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"columns of \[1, 2\] rows"):
        write_parquet(tmp_path / "t", {"a": np.zeros(1), "b": np.zeros(2)})
    with pytest.raises(ValueError, match="column a has type bool"):
        write_parquet(tmp_path / "t", {"a": np.zeros(1, dtype=bool)})
