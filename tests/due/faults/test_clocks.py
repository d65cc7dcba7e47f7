"""Wrong and jumping wall clocks lose nothing: leases are judged without comparing two machines' clocks."""

import os
import signal
import time
from pathlib import Path

import pytest

from due.drivers.embedded_redis import EmbeddedServer
from tests.due.faults.test_kill import _until

COUNT = 5_000
SIZE = 1_000
WINDOW = 1 << 19


def _clock(file: Path, offset: str) -> dict[str, str]:
    """Environment of a program whose wall clock is off by as many seconds as the file says at the moment."""
    file.write_text(offset)
    return {"FAULT_CLOCK": str(file)}


def _server_clock(offset: str) -> dict[str, str]:
    """The same for the server, for good: libfaketime of Debian's package `faketime`."""
    (library,) = Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1")
    return {"LD_PRELOAD": str(library), "FAKETIME": offset, "FAKETIME_DONT_FAKE_MONOTONIC": "1"}


@pytest.mark.parametrize("offset", ["-40", "-3600", "+3600"])
def test_a_readers_wrong_clock_loses_nothing(programs, own_server, tmp_path, offset):
    wrong = _clock(tmp_path / "clock", offset)
    reader = programs("consume", own_server.url, "reader", COUNT, 0.3, environment=wrong)
    reader.wait_for("ready")
    producer = programs("produce", own_server.url, "reliable", COUNT, SIZE, WINDOW)
    producer.wait_for("flushed")
    _until(lambda: len(reader.numbers()) >= COUNT)
    assert reader.numbers() == list(range(COUNT))


@pytest.mark.parametrize("whose", ["reader", "producer"])
def test_a_clock_that_jumps_loses_nothing(programs, own_server, tmp_path, whose):
    clocks = {name: _clock(tmp_path / name, "+0") for name in ("reader", "producer")}
    reader = programs("consume", own_server.url, "reader", COUNT, 0.3, environment=clocks["reader"])
    reader.wait_for("ready")
    producer = programs(
        "produce", own_server.url, "reliable", COUNT, SIZE, WINDOW, environment=clocks["producer"]
    )
    for seen, offset in ((1000, "+3600"), (2000, "-3600"), (3500, "+0")):
        _until(lambda seen=seen: len(reader.numbers()) >= seen)
        (tmp_path / whose).write_text(offset)
    producer.wait_for("flushed")
    _until(lambda: len(reader.numbers()) >= COUNT)
    assert reader.numbers() == list(range(COUNT))


@pytest.mark.parametrize("offset", ["-3600", "+3600"])
def test_a_server_that_comes_back_empty_with_another_time_loses_nothing(
    programs, tmp_path, monkeypatch, offset
):
    with EmbeddedServer(tmp_path / "updates") as server:
        reader = programs("consume", server.url, "reader", COUNT, 0.3)
        reader.wait_for("ready")
        producer = programs("produce", server.url, "reliable", COUNT, SIZE, WINDOW)
        _until(lambda: len(reader.numbers()) >= 1000)
        server.kill()
        with monkeypatch.context() as changed:
            for name, value in _server_clock(offset).items():
                changed.setenv(name, value)
            server.start()
        producer.wait_for("flushed")
        _until(lambda: len(reader.numbers()) >= COUNT)
        assert sorted(set(reader.numbers())) == list(range(COUNT))


@pytest.mark.parametrize("offset", ["-40", "+3600"])
def test_an_instance_with_a_wrong_clock_goes_on_where_the_dead_one_stopped(
    programs, own_server, tmp_path, offset
):
    first = programs("consume", own_server.url, "reader", COUNT, 0.3)
    first.wait_for("ready")
    producer = programs("produce", own_server.url, "reliable", COUNT, SIZE, WINDOW)
    first.wait_for("1000 ")
    first.kill()
    wrong = _clock(tmp_path / "clock", offset)
    second = programs("consume", own_server.url, "reader", 10**9, 0, environment=wrong)
    _until(lambda: set(first.numbers()) | set(second.numbers()) == set(range(COUNT)))
    producer.wait_for("flushed")
    assert second.numbers() == sorted(second.numbers())


@pytest.mark.parametrize("whose", ["server", "producer"])
def test_who_was_stopped_takes_no_reader_for_dead(programs, own_server, whose):
    """For longer than a reader may be silent: the answers that then lie in the socket say nothing of now."""
    reader = programs("consume", own_server.url, "reader", COUNT, 0.3)
    reader.wait_for("ready")
    producer = programs("produce", own_server.url, "reliable", COUNT, SIZE, WINDOW, 5)
    _until(lambda: len(reader.numbers()) >= 1000)
    pid = own_server.pid if whose == "server" else producer.process.pid
    os.kill(pid, signal.SIGSTOP)
    time.sleep(8)
    os.kill(pid, signal.SIGCONT)
    producer.wait_for("flushed")
    _until(lambda: len(reader.numbers()) >= COUNT)
    assert reader.numbers() == list(range(COUNT))
