"""A bridge over a slow link: nothing reliable is lost, and what best effort loses is counted."""

import subprocess

import pytest

from benchmarks.cluster_bridge import counts
from benchmarks.cluster_bridge_app import Arrivals
from benchmarks.cluster_bridge_stage import BridgeStage
from due import Item
from tests.requirements import require_netns, require_program


def _item(number: int) -> Item:
    return Item("a.b", [number, 0.0, b""], 0, 0, "maker", "m1", number)


def test_what_is_lost_and_what_is_counted_are_told_apart():
    """Numbers before the first arrival belong to the time before the reader; later ones that never come are lost."""
    reliable, best_effort = Arrivals(), Arrivals()
    for number in (0, 1, 3, 2, 3):
        reliable.take(_item(number))
    for number in (5, 6, 9):
        best_effort.take(_item(number))
    line = {
        "written": {"reliable": 6, "best_effort": 10},
        "gaps": 2,
        "got": {"reliable": reliable.progress(), "best_effort": best_effort.progress()},
    }
    found = counts(line)
    assert (found["written"], found["lost"], found["again"], found["disordered"]) == (6, 2, 1, 1)
    assert (found["missing"], found["gaps"]) == (2, 2)


@pytest.mark.slow
def test_a_cut_link_and_a_killed_bridge_lose_nothing_reliable(tmp_path):
    """In both directions; best-effort items that were lost are the gaps that the readers counted."""
    require_netns()
    for program in ("tc", "ethtool", "setpriv"):
        require_program(program)
    with BridgeStage(tmp_path) as stage:
        stage.load(60, 30)
        stage.wait_whole()
        stage.cut(1.0)
        stage.kill_bridge()
        stage.drain()
        found = [counts(line) for line in stage.sums().values()]
        names = [stage.link.namespace(site) for site in ("near", "far")]
    assert all(one["written"] > 0 for one in found)
    assert [(one["lost"], one["again"], one["disordered"]) for one in found] == [(0, 0, 0)] * 2
    assert [one["gaps"] for one in found] == [one["missing"] for one in found]
    assert any(one["missing"] for one in found), "the bridge was away long enough to lose something"
    left = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True).stdout
    assert not any(name in left for name in names)
