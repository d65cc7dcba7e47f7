"""Fixtures for all tests, and the promise that the suite leaves no process behind."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.requirements import IN_CI


def _children() -> set[int]:
    """Processes whose parent is this test run, zombies left out."""
    found = set()
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if int(fields[1]) == os.getpid() and fields[0] != "Z":
            found.add(int(stat.parent.name))
    return found


@pytest.fixture(scope="session", autouse=True)
def no_process_left_behind() -> Iterator[None]:
    """Every process that the suite started has ended when it ends."""
    before = _children()
    yield
    left = {pid: _command(pid) for pid in _children() - before}
    assert not left, f"the suite left processes behind: {left}"


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return "(gone)"


def pytest_report_header() -> str:
    return f"CI={IN_CI}: a missing service {'fails' if IN_CI else 'skips'} its tests"
