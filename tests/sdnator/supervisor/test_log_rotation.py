"""Logs stay within their bounds while parts write to them, and what is left out is counted."""

import pytest

from sdnator.supervisor.log_rotation import LogKeeper, put_aside
from sdnator.supervisor.spec import LogLimits

LIMITS = LogLimits(file_bytes=1_000, files=3, minute_bytes=10_000)


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "kitsune.log"
    with path.open("ab", buffering=0) as file:
        yield path, file


def content(path):
    return path.read_text() if path.exists() else ""


def test_a_long_log_is_put_aside_and_the_oldest_goes(log):
    path, file = log
    keeper = LogKeeper(LIMITS)
    for number in range(4):
        keeper.look(path, number * 100.0)
        file.write(f"{number}\n".encode() * 600)
        keeper.look(path, number * 100.0 + 1)
    file.write(b"now\n")
    assert content(path) == "now\n", "its writer goes on, at the new beginning"
    assert [content(path.with_name(f"kitsune.log.{one}"))[:1] for one in (1, 2, 3)] == ["3", "2", ""]
    assert keeper.size(path) == 4 + 2 * 1_200


def test_a_storm_is_suppressed_and_counted_and_what_was_before_stays(log):
    path, file = log
    keeper = LogKeeper(LogLimits(file_bytes=100_000, files=2, minute_bytes=1_000))
    file.write(b"before\n")
    keeper.look(path, 0.0)
    for second in range(1, 60):
        file.write(b"the same again\n" * 1_000)
        keeper.look(path, float(second))
        assert path.stat().st_size <= 1_100
    file.write(b"the end\n")
    keeper.look(path, 61.0)
    lines = content(path).splitlines()
    assert lines[0] == "before"
    assert set(lines[1:-1]) == {"the same again"}
    said = int(lines[-1].split()[1].replace(",", ""))
    assert lines[-1].startswith("sdnator: ")
    assert said == keeper.suppressed(path) == 59_000 + 1 + 1 - (len(lines) - 1)
    file.write(b"after\n")
    keeper.look(path, 62.0)
    assert content(path).endswith("after\n")


def test_a_line_longer_than_everything_is_cut(log):
    path, file = log
    keeper = LogKeeper(LIMITS)
    file.write(b"x" * (3 << 20))
    keeper.look(path, 0.0)
    assert path.stat().st_size <= LIMITS.minute_bytes


def test_a_log_that_is_not_there_is_no_fault(tmp_path):
    LogKeeper(LIMITS).look(tmp_path / "none.log", 0.0)


def test_one_file_means_that_nothing_is_put_aside(log):
    path, file = log
    file.write(b"x\n")
    put_aside(path, 1, copy=True)
    assert content(path) == ""
    assert sorted(each.name for each in path.parent.iterdir()) == ["kitsune.log"]
