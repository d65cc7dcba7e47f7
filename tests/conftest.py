"""Fixtures for all tests, how workers share them, and the promise that the suite leaves no process behind."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from xdist.scheduler import LoadFileScheduling

from tests.requirements import IN_CI

WHOLE_PIPELINES = ("tests/end_to_end/", "tests/test_docs.py")
"""Each of these tests keeps both cores of a small machine busy with processes, and some of them measure."""
ONE_SWITCH = "tests/p4/"
"""These files share a compiled switch."""
LONG = (
    "tests/apps/sonata_adapter/test_spark_cluster.py",
    "tests/apps/sonata_adapter/test_alone.py",
    "tests/apps/enforcers/test_contract.py",
    "tests/due/faults/",
    "tests/benchmarks/test_cluster_bridge.py",
    "tests/examples/test_flow_exporters.py",
    "tests/examples/test_manufacturing_kills.py",
    "tests/test_wheel.py",
)
"""Half a minute or more each: begun early, so that no worker is left alone with one in the end."""

# container images set it: then each of the many hundred processes that tests start would compile the product again
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
if not IN_CI:  # there hypothesis is patient of itself, and tries the same examples each time
    settings.load_profile("patient")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The longest piece first: one worker is busy with it while the others take all the rest, long files first."""
    if hasattr(config, "workerinput"):
        items.sort(
            key=lambda item: (not item.nodeid.startswith(WHOLE_PIPELINES), not item.nodeid.startswith(LONG))
        )


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LoadFileScheduling:
    """Share the tests between workers: a file is one piece, so that its fixtures are made once."""
    return Pieces(config, log)


class Pieces(LoadFileScheduling):
    """Whole pipelines are one piece together: no two of them are measured side by side.

    A scheduler of our own, because the groups of `--dist loadgroup` do nothing with pytest 9.2.
    """

    def _split_scope(self, nodeid: str) -> str:
        if nodeid.startswith(WHOLE_PIPELINES):
            return "whole pipelines"
        return ONE_SWITCH if nodeid.startswith(ONE_SWITCH) else nodeid.partition("::")[0]


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
