"""What a measurement looks at: processes, the archive's size, the configuration of switches."""

import sqlite3
import subprocess
import sys
import tomllib

import pytest

from sdnator.errors import PipelineError
from sdnator.plan.measure import Schedule, _more_cpu, one_switch, over_idle, processor
from sdnator.plan.measured_pipeline import LoadPhase, archive_bytes, configuration
from sdnator.plan.processes import usages
from sdnator.plan.reference_work import ReferenceWork, work

BUSY = """
import os, sys
held = bytearray(40 << 20)
while os.times().user < 0.2:
    pass
sys.stdout.write("x" * 100_000)
sys.stdout.flush()
sys.stdin.read()
"""


ABOVE = """
import subprocess, sys
with subprocess.Popen([sys.executable, "-c", sys.argv[1]]) as child:
    print(child.pid, file=sys.stderr, flush=True)
"""


def test_processes_below_one_are_found_with_what_they_use():
    """A known one by its name, with what it wrote; others belong to the one above them."""
    with subprocess.Popen(
        [sys.executable, "-c", ABOVE, BUSY],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as above:
        assert above.stdout is not None
        assert above.stderr is not None
        child = int(above.stderr.readline())
        assert len(above.stdout.read(100_000)) == 100_000
        known = usages(above.pid, {child: "kitsune"}, memory=True)
        unknown = usages(above.pid, {})
        assert above.stdin is not None
        above.stdin.close()
    assert known["kitsune"].processes == 1
    assert known["kitsune"].cpu_s >= 0.2
    assert known["kitsune"].kib >= 40 << 10
    assert known["kitsune"].written >= 100_000
    assert known["supervisor"].processes == 1
    assert unknown["supervisor"].processes == 2
    assert unknown["supervisor"].kib == 0


def test_the_archive_is_as_large_as_its_pages(tmp_path):
    """Those that stand in the log, too; without those that are free."""
    file = tmp_path / "it's an archive.db"
    assert archive_bytes(file) == 0
    connection = sqlite3.connect(file, isolation_level=None)
    connection.executescript("PRAGMA journal_mode=WAL; CREATE TABLE t(x)")
    before = archive_bytes(file)
    connection.execute("INSERT INTO t VALUES(?)", (bytes(500_000),))
    after = archive_bytes(file)
    assert 490_000 <= after - before < 520_000
    connection.execute("DELETE FROM t")
    assert archive_bytes(file) == pytest.approx(before, abs=8192)
    connection.close()


def test_switches_get_ids_and_ports():
    found = tomllib.loads(configuration(['"1=veth:a", "2=veth:b"', '"1=null", "2=null"']))
    assert [each["name"] for each in found["switches"]] == ["s1", "s2"]
    assert [each["device_id"] for each in found["switches"]] == [1, 2]
    assert found["switches"][0]["ports"] == ["1=veth:a", "2=veth:b"]


def test_what_is_idle_is_no_cost_of_packets():
    idle = LoadPhase(elapsed_s=10, cpu_s={"kitsune": 1.0}, archived=0, updates_in=0, updates_out=0)
    busy = LoadPhase(
        elapsed_s=20, load_s=15, sent=100, cpu_s={"kitsune": 5.0, "switch": 0.5},
        archived=0, updates_in=0, updates_out=0,
    )  # fmt: skip
    assert over_idle(busy, idle, "kitsune") == pytest.approx(3)
    assert over_idle(busy, idle, "switch") == pytest.approx(0.5)
    assert over_idle(idle, idle, "kitsune") == 0


def test_phases_are_compared_at_one_speed():
    """What took 6 s of CPU while the reference work took 1.2 ms takes less where that takes 1 ms."""
    phase = LoadPhase(
        elapsed_s=10, cpu_s={"kitsune": 6.0}, archived=7, updates_in=8, updates_out=9, reference_us=1200.0
    )
    found = phase.at(1000.0)
    assert found.cpu_s == {"kitsune": pytest.approx(5)}
    assert (found.archived, found.reference_us) == (7, 1000)
    assert phase.at(0.0) is phase


def test_the_reference_work_is_done_at_once_and_measured():
    assert work() == work()
    with ReferenceWork() as reference:
        pass
    assert reference.us > 0


def test_rates_are_measured_from_the_lowest():
    assert list(Schedule().rates) == sorted(Schedule().rates)
    assert processor()


class FakePipeline:
    """Each packet costs 50 µs and 400 bytes; more than 1,000 a second are too many."""

    def idle(self, seconds):
        return LoadPhase(
            elapsed_s=seconds, cpu_s={"kitsune": 0.1 * seconds, "spare": 0.0},
            archived=0, updates_in=0, updates_out=0,
        )  # fmt: skip

    def loaded(self, pps, seconds):
        sent = round(pps * seconds)
        return LoadPhase(
            elapsed_s=seconds + 2, load_s=seconds, sent=sent, carried=pps <= 1000,
            cpu_s={"kitsune": 0.1 * (seconds + 2) + sent * 50e-6, "spare": 0.0},
            archived=400 * sent, updates_in=500 * sent, updates_out=0,
        )  # fmt: skip

    def mib(self):
        return {"kitsune": 100.0, "spare": 40.0}

    def health(self):
        keys = {"network.switch.app.s1": 3, "network.anomaly.app.score": 9}
        return {"kitsune": {"health": {"engine": {"keys": keys}}}, "firewall": {}}


def test_costs_are_those_of_the_rates_that_were_carried():
    """Training comes first; what could not be carried is left out and said."""
    told = []
    schedule = Schedule(rates=(100.0, 1000.0, 4000.0), seconds=10, more=False)
    costs = one_switch(FakePipeline(), schedule, 80_000, told.append)
    assert costs.rates == (100, 1000)
    assert costs.note == "4,000 packets a second were too many"
    kitsune, spare = costs.processes["kitsune"], costs.processes["spare"]
    assert kitsune.us_per_packet == pytest.approx((50, 50))
    assert (kitsune.idle_cores, kitsune.mib, kitsune.per_switch) == (pytest.approx(0.1), 100, False)
    assert (spare.us_per_packet, spare.per_switch) == ((0, 0), True)
    assert (costs.archive, costs.updates_in) == (pytest.approx((400, 400)), pytest.approx((500, 500)))
    assert (costs.keys, costs.switch_keys) == (2, 1)
    assert min(costs.topics) > 0
    assert "training on 80,000 packets" in told


def test_a_machine_that_carries_nothing_is_told():
    with pytest.raises(PipelineError, match="cannot carry 4,000"):
        one_switch(FakePipeline(), Schedule(rates=(4000.0,), more=False), 80_000, lambda _: None)


def test_small_differences_are_no_cost():
    """Repeating a phase differs by as much."""
    idle = LoadPhase(elapsed_s=10, cpu_s={}, archived=0, updates_in=0, updates_out=0)

    def used(seconds):
        return LoadPhase(
            elapsed_s=10, load_s=10, sent=1000, cpu_s={"updates": seconds},
            archived=0, updates_in=0, updates_out=0,
        )  # fmt: skip

    assert _more_cpu(used(1.04), used(1.0), idle, "updates") == 0
    assert _more_cpu(used(0.9), used(1.0), idle, "updates") == 0
    assert _more_cpu(used(1.1), used(1.0), idle, "updates") == pytest.approx(0.0001)
    assert _more_cpu(used(0.02), used(0.0), idle, "updates") == 0
