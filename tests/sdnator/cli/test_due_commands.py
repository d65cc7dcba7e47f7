"""Keys and times as typed; what is shown of items that come and of items of the past."""

import json
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from due import PRODUCER, Capability, Engine, Item, Options, RecordBatch
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.sqlite import SqliteArchive
from sdnator.cli.due_commands import text_line
from sdnator.errors import BadInput, PipelineError
from sdnator.northbound import latest
from sdnator.notation import brief, duration_ns, instant_ns, local_time, typed_key
from tests.end_to_end.operator_app import app

HOUR = 3_600 * 10**9


@pytest.fixture(autouse=True)
def no_pipeline(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    for variable in ("DUE_UPDATES", "DUE_ARCHIVE"):
        monkeypatch.delenv(variable, raising=False)


def run(*words):
    return CliRunner().invoke(app, list(words), catch_exceptions=False)


def make_item(sequence, timestamp, value=1, key="a.b.c"):
    return Item(key, value, timestamp, timestamp, "app", "instance", sequence)


@pytest.mark.parametrize(
    ("typed", "key"),
    [
        ("a.b.c", "a.b.c"),
        ("a.*.**", "a.*.**"),
        ("a.b:dst=fe80::1,port=5", "a.b:dst=fe80%3A%3A1,port=5"),
        ("a.b:mac=00:0c:29:5e:71:b4", "a.b:mac=00%3A0c%3A29%3A5e%3A71%3Ab4"),
        ("a.b:dst=fe80%3A%3A1", "a.b:dst=fe80%3A%3A1"),
        ("a.b:window=*", "a.b:window=*"),
        ("a.b:flag=syn|ack", "a.b:flag=ack|syn"),
    ],
)
def test_addresses_need_not_be_encoded(typed, key):
    assert typed_key(typed) == key


@pytest.mark.parametrize("typed", ["", "a..b", "a b", "a:x", "a:", "a.**.b"])
def test_wrong_keys_are_told_with_position_and_rule(typed):
    with pytest.raises(BadInput, match="position"):
        typed_key(typed)


def test_times_as_people_write_them():
    assert duration_ns("30s", "--for") == 30 * 10**9
    assert duration_ns("1.5h", "--for") == HOUR * 3 // 2
    assert duration_ns("250ms", "--for") == 250 * 10**6
    assert instant_ns("1h", 5 * HOUR, "--since") == 4 * HOUR
    assert instant_ns("1970-01-01T01:00", 0, "--since") == HOUR
    assert instant_ns("1970-01-01T01:00:00.5+01:00", 0, "--since") == HOUR // 7200
    for text in ("", "1", "h", "soon", "1y"):
        with pytest.raises(BadInput, match="--since"):
            instant_ns(text, 0, "--since")


@given(
    times=st.lists(st.integers(0, 3 * 86_400 * 10**9), max_size=30),
    start=st.integers(0, 3 * 86_400 * 10**9),
    length=st.integers(0, 3 * 86_400 * 10**9),
    limit=st.integers(1, 40),
)
def test_the_latest_are_those_of_looking_at_all(times, start, length, limit):
    """Looking farther and farther back finds what one look at everything finds, and reads one item more at most."""
    end = start + length
    items = [make_item(number, when) for number, when in enumerate(sorted(times), 1)]

    def find(query, *, limit):
        assert limit <= most
        bounds = query["$and"][1]["timestamp"]
        return [item for item in items if bounds["$gte"] <= item.timestamp < bounds["$lt"]][-limit:]

    most = limit + 1
    inside = [item for item in items if start <= item.timestamp < end]
    assert latest(find, {}, start, end, limit) == (inside[-limit:], len(inside) > limit)


def test_one_line_tells_the_size_of_what_is_long():
    batch = RecordBatch({"time_us": np.arange(3), "length": np.arange(3)})
    assert brief(batch) == "3 records of time_us, length"
    assert brief({"score": np.zeros(4), "raw": b"12345", "n": [1, float("nan")]}) == {
        "score": "4 of float64",
        "raw": "5 bytes",
        "n": [1, "nan"],
    }
    line = text_line(make_item(1, 10**9, {"reason": "x\ny" * 500}))
    assert line.startswith(f'{local_time(10**9, fraction=True)}  a.b.c  {{"reason": "x')
    assert "\n" not in line
    assert len(line) < 300


@pytest.fixture
def archive(tmp_path):
    """Three items of an hour ago, one of now; its URL."""
    url = f"sqlite://{tmp_path}/archive.db"
    now = time.time_ns()
    driver = SqliteArchive(url)
    driver.insert([make_item(number, now - HOUR + number, number) for number in (1, 2, 3)])
    driver.insert([make_item(4, now - 10**9, RecordBatch({"x": np.arange(2)}), "a.b.d")])
    driver.close()
    return url


def test_get_shows_the_past_without_a_pipeline(archive):
    done = run("get", "a.b.*", "--archive", archive, "--json")
    items = [json.loads(line) for line in done.stdout.splitlines()]
    assert [item["value"] for item in items] == [1, 2, 3, {"x": [0, 1]}]
    assert set(items[0]) == {"dataKey", "value", "timestamp", "eventTime", "appId", "instanceId", "sequence"}
    assert "2 records of x" in run("get", "a.b.*", "--archive", archive, "--since", "1min").stdout
    assert run("get", "a.b.*", "--archive", archive, "--since", "1min").stdout.count("\n") == 1
    done = run("get", "a.b.c", "--archive", archive, "--limit", "2")
    assert done.stdout.count("\n") == 2
    assert "--limit 2" in done.stderr
    assert "no items under a.x" in run("get", "a.x", "--archive", archive).stderr


def test_get_makes_no_archive_where_none_is(tmp_path):
    with pytest.raises(BadInput, match="no archive"):
        run("get", "a.b")
    assert not (tmp_path / "data").exists()
    with pytest.raises(BadInput, match="postgres"):
        run("get", "a.b", "--archive", "postgres://x")


def test_observe_needs_somewhere_to_look():
    with pytest.raises(PipelineError, match="sdnator up"):
        run("observe", "a.b")
    with pytest.raises(PipelineError, match=r"127\.0\.0\.1:1"):
        run("observe", "a.b", "--updates", "redis://127.0.0.1:1/0", "--for", "1s")
    with pytest.raises(BadInput, match="--for"):
        run("observe", "a.b", "--for", "long")


def test_observe_shows_what_comes_and_ends_by_count(tmp_path):
    """Each observer gets everything of a reliable stream, as JSON lines."""
    with EmbeddedServer(tmp_path / "updates") as server:
        producer = Engine(Options(updates=server.url, directory=str(tmp_path / "p"), coordinated=False))
        producer.init("maker", PRODUCER, capabilities=[Capability("a.b.maker", delivery="reliable")])
        done = threading.Event()

        def write():
            while not done.wait(0.02):
                producer.write("a.b.maker", {"n": 1})
                producer.flush()

        writer = threading.Thread(target=write)
        writer.start()
        try:
            shown = run("observe", "a.b.*", "--updates", server.url, "--count", "3", "--json")
            timed = run("observe", "x.y", "--updates", server.url, "--for", "200ms")
        finally:
            done.set()
            writer.join()
            producer.close()
    items = [json.loads(line) for line in shown.stdout.splitlines()]
    assert [item["value"] for item in items] == [{"n": 1}] * 3
    assert "3 items" in shown.stderr
    assert (timed.exit_code, timed.stdout) == (0, "")
    assert "sdnator keys" in timed.stderr


def test_a_viewer_that_does_not_keep_up_misses_items_and_holds_nobody_back(tmp_path, monkeypatch):
    """The queue is bounded; what finds no room is counted and told."""
    monkeypatch.setattr("sdnator.cli.live_items._WAITING", 1)
    with EmbeddedServer(tmp_path / "updates") as server:
        producer = Engine(Options(updates=server.url, directory=str(tmp_path / "p"), coordinated=False))
        producer.init("maker", PRODUCER, capabilities=[Capability("a.b.maker", delivery="reliable")])
        done = threading.Event()

        def write():
            while not done.wait(0.01):
                for number in range(500):
                    producer.write("a.b.maker", number)
                producer.flush()

        writer = threading.Thread(target=write)
        writer.start()
        try:
            shown = run("observe", "a.b.*", "--updates", server.url, "--count", "20")
        finally:
            done.set()
            writer.join()
            producer.close()
    assert "missed" in shown.stderr
