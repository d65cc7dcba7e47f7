"""Processor time of the host for each million packets through the switch: nothing wanted, the paper's eleven, all copied.

The host is the controller, the adapter, the Coordinator and Data Updates.  The rounds of the three alternate, so that the
ratio does not depend on the machine; what the parts use while nothing is wanted is told, and not subtracted.
"""

import os
import statistics
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from apps.sonata_adapter.query.catalogue import PAPER
from benchmarks.sonata_sets import ROUND_US
from benchmarks.sonata_stage import QUERIES, SonataStage
from benchmarks.sonata_traffic import FrameColumns, traffic
from sdnator.testing.controller_run import PACKETS
from sdnator.testing.query_traffic import BASE_US
from sdnator.testing.waiting import wait_for

_FASTER: Final = 4.0
_PEERS: Final[dict[str, Sequence[str]]] = {
    "nothing": (),
    "queries": [QUERIES[name] for name in PAPER],
    "copies": (PACKETS,),
}


class CostStage(SonataStage):
    """Wants keys, plays traffic, and tells what that cost."""

    def cost(self, keys: Sequence[str], frames: FrameColumns, number: int) -> float:
        """Processor time while the frames pass and what comes of them is worked off, s."""
        wanted = [self._observer.observe(key).subscribe(lambda _item: None) for key in keys]
        wait_for(lambda: bool(self._telemetry) == bool(keys), 60, self.log)
        self._calm()
        before = self._cpu_s()
        self.play(frames, faster=_FASTER, zero=BASE_US - number * ROUND_US)
        self._calm()
        used = self._cpu_s() - before
        for each in wanted:
            each.dispose()
        wait_for(lambda: not self._telemetry, 60, self.log)
        return used

    def _calm(self) -> None:
        self._health.items.clear()
        wait_for(self._quiet, 120)

    def _cpu_s(self) -> float:
        pids = [process.pid for process in self.processes]
        return sum(map(_used_s, [*pids, self.server.pid]))


def _used_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def cost_figures(rounds: int) -> dict[str, Any]:
    """`host_cpu_per_million_packets` of each, medians of the rounds, and the ratio."""
    loud, rest = traffic(1)
    costs: dict[str, list[float]] = {name: [] for name in _PEERS}
    number = 0
    with tempfile.TemporaryDirectory() as folder, CostStage(Path(folder)) as stage:
        for _ in range(rounds):
            for name, keys in _PEERS.items():
                used = 0.0
                for part in (loud, rest):
                    number += 1
                    used += stage.cost(keys, part, number)
                costs[name].append(used / (len(loud) + len(rest)) * 1e6)
    middle = {name: round(statistics.median(each), 2) for name, each in costs.items()}
    ratios = [mine / theirs for mine, theirs in zip(costs["queries"], costs["copies"], strict=True)]
    return {
        "host_cpu_per_million_packets": middle,
        "host_cpu_ratio": round(statistics.median(ratios), 3),
        "host_cpu_ratio_rounds": [round(each, 3) for each in ratios],
    }
