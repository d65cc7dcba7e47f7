"""`sdnator archive export`: every archived row in the file of its hour, once, whatever happened before."""

import json
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from apps.packets import PACKET_COLUMNS
from due import Item, RecordBatch
from due.backends import open_archive
from sdnator.archive_export import archive_items, hour_files
from sdnator.archive_export.archive_items import archived_items
from sdnator.archive_export.export import PACKETS, ExportRequest, export
from sdnator.archive_export.export_folder import name_of, opened
from sdnator.cli.archive_commands import archive_app
from sdnator.errors import BadInput, PipelineError
from sdnator.testing.archived_packets import archive_packets, out_of_order
from sdnator.testing.query_traffic import BASE_US, mixed
from tests.due.drivers.mongo_server import PATIENT, nx_server

pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")

HOUR_US, HOUR_NS = 3_600 * 10**6, 3_600 * 10**9
EDGE_US = -(-BASE_US // HOUR_US) * HOUR_US
SHIFT_US = EDGE_US - BASE_US - 6_000_000
BEGIN_NS = 472_300 * HOUR_NS - 5 * 10**9
"""Five seconds before an hour of the archive ends."""
PERIOD = ("--since", "2023-11-18T02:00:00+00:00", "--until", "2023-11-18T06:00:00+00:00")


class Killed(BaseException):
    """Nothing goes on behind it."""


@pytest.fixture
def frames():
    return out_of_order(mixed(["ddos", "syn_flood"], seconds=12), 3_000_000)


@pytest.fixture
def url(tmp_path, frames):
    """An archive whose packets cross an hour of event time, and one of the archive."""
    found = f"sqlite://{tmp_path}/archive.db"
    with closing(open_archive(found)) as archive:
        archive_packets(archive, "s1", frames, base_us=BASE_US, begin_ns=BEGIN_NS, shift_us=SHIFT_US)
    return found


def run(*arguments, code=0):
    done = CliRunner().invoke(archive_app, [str(each) for each in arguments], catch_exceptions=False)
    assert done.exit_code == code, done.output
    return done


def exported(folder, url, *more):
    return json.loads(run("export", "--parquet", folder, "--archive", url, *PERIOD, "--json", *more).stdout)


def tables(folder):
    return {
        path.relative_to(folder): pq.read_table(path, partitioning=None)
        for path in sorted(folder.glob("*/*/*.parquet"))
    }


def test_rows_are_in_the_files_of_their_hours(tmp_path, url, frames):
    """Column by column what the archive holds; the order of the archive can be told from the rows."""
    told = exported(tmp_path / "day", url)
    found = tables(tmp_path / "day")
    assert told["rows"] == sum(table.num_rows for table in found.values()) == len(frames)
    assert (told["hours"], told["incomplete"], told["refused"], told["files"]) == (4, 0, 0, len(found))
    for path, table in found.items():
        day, hour = (part.partition("=")[2] for part in path.parts[:2])
        begin = int(np.datetime64(f"{day}T{hour}", "us").astype(int))
        times = table["time_us"].to_numpy()
        assert begin <= times.min() <= times.max() < begin + HOUR_US
    assert {path.name for path in found} == {f"{name_of(hour)}-000.parquet" for hour in (472_299, 472_300)}
    assert len({path.parts[:2] for path in found}) == 2
    whole = pq.read_table(tmp_path / "day")  # as other programs read it
    assert whole.num_rows == len(frames)
    assert {"date", "hour"} <= set(whole.column_names)
    columns = {
        name: np.concatenate([table[name].to_numpy() for table in found.values()])
        for name in (*PACKET_COLUMNS, "archive_row", "archive_item", "archive_ns")
    }
    order = np.argsort(columns["archive_row"])
    with closing(open_archive(url)) as archive:
        items = list(archived_items(archive, PACKETS, BEGIN_NS, BEGIN_NS + HOUR_NS))
    for name, kind in PACKET_COLUMNS.items():
        assert np.array_equal(columns[name][order], np.concatenate([item.value[name] for item in items]))
        assert columns[name].dtype == np.dtype(kind)
    written = np.concatenate([np.full(len(item.value), item.timestamp) for item in items])
    assert np.array_equal(columns["archive_ns"][order], written)
    assert len(np.unique(columns["archive_item"])) == len(items)


def test_the_archive_may_be_in_mongodb(tmp_path, url, frames):
    """The same rows as out of SQLite, with the same places."""
    exported(tmp_path / "day", url)
    with nx_server(tmp_path) as server:
        mongo = f"{server}?{PATIENT}"
        with closing(open_archive(mongo)) as archive:
            archive_packets(archive, "s1", frames, base_us=BASE_US, begin_ns=BEGIN_NS, shift_us=SHIFT_US)
        exported(tmp_path / "other", mongo)
    found, other = tables(tmp_path / "day"), tables(tmp_path / "other")
    assert found.keys() == other.keys()
    assert all(table.equals(other[path]) for path, table in found.items())


def test_an_hour_takes_the_place_of_its_predecessor(tmp_path, url):
    """Exported again it is the same; what was pruned is gone, and so are the files that held it."""
    folder = tmp_path / "day"
    first = exported(folder, url)
    before = tables(folder)
    assert exported(folder, url) == first
    assert all(table.equals(before[path]) for path, table in tables(folder).items())
    with closing(open_archive(url)) as archive:
        archive.prune(before=472_300 * HOUR_NS)
    assert exported(folder, url, "--only-missing") == {**first, "kept": 4}
    second = exported(folder, url)
    left = [path for path in before if name_of(472_300) in path.name]
    assert sorted(tables(folder)) == left
    assert 0 < second["rows"] == sum(before[path].num_rows for path in left) < first["rows"]


def test_after_a_kill_no_hour_is_missing_or_twice(tmp_path, url, monkeypatch):
    """Killed while files come into their places: that hour does not count, and the next run repairs it."""
    folder = tmp_path / "day"
    whole = exported(tmp_path / "whole", url)
    moved = []
    replace = Path.replace

    def killed(self, target):
        if self.suffix == ".parquet":
            moved.append(target)
            if len(moved) == 3:
                raise Killed
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", killed)
    with pytest.raises(Killed):
        exported(folder, url)
    monkeypatch.undo()
    (folder / "_new").mkdir(exist_ok=True)
    (folder / "_new" / "left.parquet").write_bytes(b"half")
    again = exported(folder, url, "--only-missing")
    assert {**again, "folder": "", "kept": 0, "bytes": 0} == {**whole, "folder": "", "bytes": 0}
    assert again["kept"] == 2
    assert sorted(tables(folder)) == sorted(tables(tmp_path / "whole"))
    assert not (folder / "_new").exists()


def test_memory_is_bounded_whatever_the_times_are(tmp_path, url, frames, monkeypatch):
    """Few rows may wait and one file be open: more files, the same rows; the archive is read in short pieces."""
    monkeypatch.setattr(hour_files, "_GROUP_ROWS", 64)
    monkeypatch.setattr(hour_files, "_MOST_WAITING", 100)
    monkeypatch.setattr(hour_files, "_MOST_OPEN", 1)
    for name, value in (("_FIRST_NS", 2 * 10**9), ("_MANY_ROWS", 300), ("_FEW_ROWS", 100)):
        monkeypatch.setattr(archive_items, name, value)
    told = exported(tmp_path / "day", url)
    found = tables(tmp_path / "day")
    assert told["files"] == len(found) > 4
    rows = np.concatenate([table["archive_row"].to_numpy() for table in found.values()])
    assert len(np.unique(rows)) == len(rows) == len(frames)


def test_what_is_no_packet_is_counted(tmp_path, url):
    """Items of another shape or of another app, and times that cannot be, are left out; the rest is there."""
    key = "network.packets.p4runtime_ctrl.s1.all"
    with closing(open_archive(url)) as archive:
        (good, *_) = archived_items(archive, PACKETS, BEGIN_NS, BEGIN_NS + HOUR_NS)
        late = RecordBatch({**good.value, "time_us": np.full(len(good.value), -1)})
        values = [(5, "p4runtime_ctrl"), (late, "p4runtime_ctrl"), (good.value, "somebody")]
        archive.insert(
            [
                Item(key, value, BEGIN_NS + 1, BEGIN_NS, app, "other", number)
                for number, (value, app) in enumerate(values, 1)
            ]
        )
    done = run("export", "--parquet", tmp_path / "day", "--archive", url, *PERIOD)
    assert "3 items left out" in done.stderr
    assert "4 hours" in done.stdout


def test_other_columns_can_be_exported(tmp_path, url):
    """Any columns of numbers or text, at their item's event time; those with other columns are counted."""

    def item(number, columns):
        return Item(
            "lab.rates.meter.a",
            RecordBatch(columns),
            BEGIN_NS + number,
            EDGE_US * 1000 + number,
            "meter",
            "m",
            number,
        )

    with closing(open_archive(url)) as archive:
        archive.insert(
            [
                item(
                    1,
                    {
                        "rate": np.array([0.5, 1.5]),
                        "name": np.array(["a", "bc"]),
                        "ok": np.array([True, False]),
                    },
                ),
                item(2, {"rate": np.array([2.5]), "name": np.array(["def"]), "ok": np.array([True])}),
                item(3, {"rate": np.array([1])}),
                item(4, {"rate": np.array([1j])}),
            ]
        )
    told = exported(tmp_path / "rates", url, "--key", "lab.rates.**")
    (table,) = tables(tmp_path / "rates").values()
    assert table["rate"].to_pylist() == [0.5, 1.5, 2.5]
    assert table["name"].to_pylist() == ["a", "bc", "def"]
    assert set(table["time_us"].to_pylist()) == {EDGE_US}
    assert set(table["archive_key"].to_pylist()) == {"lab.rates.meter.a"}
    assert (told["rows"], told["refused"]) == (3, 2)


def test_what_cannot_be_used_is_said(tmp_path, url, monkeypatch):
    """Which option, what is wrong, and what to do."""
    file, other = tmp_path / "file", tmp_path / "other"
    file.write_text("text")
    other.mkdir()
    (other / "mine.txt").write_text("text")
    exported(tmp_path / "day", url)
    for folder, more, text in (
        (file, (), "is not a folder"),
        (file / "below", (), "is not a folder"),
        (other, (), "holds other files"),
        (tmp_path / "day", ("--key", "a.b"), "holds network.packets"),
        (tmp_path / "new", ("--key", "a..b"), "invalid key"),
        (tmp_path / "new", ("--since", "1h", "--until", "2h"), "before the end"),
        (tmp_path / "new", ("--archive", f"sqlite://{tmp_path}/nowhere.db"), "no archive at"),
        (tmp_path / "new", ("--archive", "ftp://x"), "use sqlite"),
    ):
        with pytest.raises(BadInput, match=text):
            run("export", "--parquet", folder, "--archive", url, *PERIOD, *more)
    with (
        opened(tmp_path / "day", f"{url}", PACKETS),
        pytest.raises(PipelineError, match="another export"),
    ):
        exported(tmp_path / "day", url)
    state = tmp_path / "day" / "_export"
    hour = state / f"{name_of(472_300)}.json"
    hour.write_text(hour.read_text().replace("date=", "../date="))
    with pytest.raises(BadInput, match="names files elsewhere"):
        exported(tmp_path / "day", url)
    (state / "about.json").write_text("{")
    with pytest.raises(BadInput, match="damaged"):
        exported(tmp_path / "day", url)
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(BadInput, match=r"sdnator\[arrow\]"):
        exported(tmp_path / "new", url)


def test_an_archive_that_does_not_answer_is_a_failure(tmp_path):
    """With what to do next; what was exported before is kept."""
    with pytest.raises(PipelineError, match="--only-missing"):
        exported(tmp_path / "day", "mongodb://127.0.0.1:1/due?serverSelectionTimeoutMS=100")


def test_an_hour_that_is_not_over_is_exported_again(tmp_path):
    """It is not whole, so more may come."""
    with (
        closing(open_archive("memory://export")) as archive,
        opened(tmp_path / "day", "memory://", PACKETS) as folder,
    ):
        now = time.time_ns()
        frames = mixed([], seconds=1)
        archive_packets(archive, "s1", frames[:100], base_us=BASE_US, begin_ns=now, every_ns=1)
        told = []
        request = ExportRequest(begin=now, end=now + 1, only_missing=True)
        for switch in ("s1", "s2"):
            (hour,), kept = export(archive, folder, request, lambda *about: told.append(about))
            assert (hour.whole, kept) == (False, 0)
            if switch == "s1":
                archive_packets(archive, "s2", frames[100:], base_us=BASE_US, begin_ns=now, every_ns=1)
        assert hour.rows == len(frames)
        assert hour.keys == [f"network.packets.p4runtime_ctrl.{switch}.all" for switch in ("s1", "s2")]
        assert told[-1] == (name_of(hour.hour), 1, 1, len(frames))
