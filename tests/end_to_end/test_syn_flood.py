"""Real SYN floods in network namespaces: without the product nobody connects, with it nobody notices.

The bounds are wide, since a busy machine is slow for clients too; `benchmarks.syn_flood` measures.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import pytest

from sdnator.demos.syn_flood.demo import VOID_FROM, guard, named, start_product
from sdnator.demos.syn_flood.lab import PLANS, Lab
from sdnator.demos.syn_flood.records import success
from sdnator.demos.syn_flood.stage import FloodStage
from sdnator.demos.syn_flood.trial import Trial, TrialHosts, TrialOutcome
from tests.requirements import require_netns, shared_data

pytestmark = pytest.mark.slow

LEARNING, UNPROTECTED, CROWD, ARMED, FOUND = 1, 2, 3, 10, 30
BURST = 32
"""SYNs that pass an armed guard at once, and as many a challenge: half-open connections of a flood."""


def namespaces() -> str:
    return subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True).stdout


@dataclass(frozen=True)
class Ground:
    """A running stage, and what happened on it before the product was there."""

    field: TrialHosts
    unprotected: TrialOutcome

    def flood(self, sources, service: int, *, seconds: float = 4.2, **changes) -> TrialOutcome:
        return self.field.run(Trial(sources=sources, service=service, seconds=seconds, **changes))


@pytest.fixture(scope="module")
def ground(tmp_path_factory) -> Iterator[Ground]:
    """One stage for all floods, each against a service of its own; nothing is left of it."""
    require_netns()
    folder = tmp_path_factory.mktemp("syn-flood")
    with Lab() as lab, FloodStage(lab, folder, switch="embedded", guard=guard(5000)) as stage:
        field = TrialHosts(stage, [plan.service(each) for plan in PLANS.values() for each in range(1, 50)])
        trial = Trial(sources="spoofed", service=UNPROTECTED, seconds=4.7, protection="none")
        outcome = field.run(trial)
        lab.flush_metrics()
        guarded = [
            named(plan.service(number)) for plan in PLANS.values() for number in range(ARMED, ARMED + 10)
        ]
        start_product(stage, guarded)
        field.wait_guarded(len(guarded))
        field.learn(PLANS, lambda version: PLANS[version].service(LEARNING))
        yield Ground(field, outcome)
    assert f"sdn{os.getpid()}-" not in namespaces()


def test_unprotected_service_is_lost(ground):
    """Or the other tests say nothing."""
    seen = ground.unprotected
    assert seen.tried
    assert seen.known_success is not None
    assert seen.known_success < VOID_FROM
    assert (seen.new_success or 0.0) < VOID_FROM


@pytest.mark.parametrize(
    ("sources", "version", "service"),
    [("spoofed", 4, 0), ("spoofed", 6, 0), ("one", 6, 1), ("hundred", 4, 2)],
)
def test_guarded_service_goes_on_from_the_first_packet(ground, sources, version, service):
    """Known clients connect at once, new ones at their second SYN; the backlog stays nearly empty."""
    seen = ground.flood(sources, ARMED + service, version=version)
    assert seen.known_success >= 0.9
    assert seen.new_success >= 0.8
    assert 0 < seen.half_open_peak <= 3 * BURST
    assert seen.challenged_ms is not None
    assert max(sum(each.values()) for each in ground.field.records.entries()) < 5000


def test_attacker_who_repeats_his_syns_is_asked_for_a_cookie(ground):
    """Every SYN again after a second passes the first challenge, not the second."""
    before = ground.field.records.counter("cookie_sent")
    seen = ground.flood("repeating", ARMED + 3, seconds=6.0)
    assert seen.known_success >= 0.9
    assert seen.new_success >= 0.7
    assert ground.field.records.counter("cookie_sent") > before
    assert ground.field.records.counter("cookie_returned") > 0


def test_real_flood_is_kept_off(ground):
    """A recorded flood, re-timed, from its 37,623 sources."""
    capture = str(shared_data("captures/synflood_spoofed.pcap"))
    seen = ground.flood("capture", ARMED + 4, capture=capture)
    assert seen.known_success >= 0.9
    assert seen.new_success >= 0.8


def test_crowd_is_not_cut_off(ground):
    """Many new clients that finish their handshakes all connect, and none is blocked."""
    field, address = ground.field, PLANS[4].service(CROWD)
    begun = time.time()
    field.aim(address, known_rate=0.0, new_rate=150.0)
    field.wait_until(lambda: len(field.records.towards(address)) > 300, 60.0, "the crowd")
    field.aim(address, known_rate=0.0, new_rate=0.0)
    field.watch(3.5)
    crowd = [each for each in field.records.towards(address) if each.at >= begun]
    assert success(crowd, time.time()) >= 0.9
    blocked = [each.target.address for each in field.stage.decisions if each.action == "block"]
    assert not any(PLANS[4].is_client(each) for each in blocked)


def test_unguarded_service_is_found_and_helped(ground):
    """The query sees the flood, the firewall guards the service or blocks the sources, and no client."""
    trial = Trial(sources="one", service=FOUND, seconds=90.0, after_rule=0.0)
    # each SYN is copied until the rule is there: a rate that a busy machine's controller can take
    seen = ground.field.run(replace(trial, protection="found", rate=1500))
    made = ground.field.stage.decisions
    assert seen.mitigated_ms is not None, made
    blocked = [each.target.address for each in made if each.action == "block"]
    assert not any(PLANS[4].is_client(each) for each in blocked)


@pytest.mark.parametrize(("number", "phase"), [(signal.SIGINT, "with the"), (signal.SIGTERM, "without")])
def test_interrupted_run_leaves_nothing_behind(number, phase, tmp_path):
    """Neither namespaces nor processes, whenever it is stopped, and if it is told so twice."""
    require_netns()
    program = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from sdnator.demos.syn_flood.demo import SynFloodOptions, Told, run_syn_flood\n"
        "options = SynFloodOptions(unprotected_seconds=4.5, seconds=60)\n"
        "run_syn_flood(options, Told(second=lambda line: print(line.phase, flush=True)))\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "TMPDIR": str(tmp_path)},
        text=True,
    ) as run:
        assert run.stdout is not None
        assert any(line.startswith(phase) for line in run.stdout)
        assert f"sdn{run.pid}-victim" in namespaces()
        run.send_signal(number)
        time.sleep(0.3)
        run.send_signal(number)  # the impatient do
        assert run.wait(60) != 0
    assert f"sdn{run.pid}-" not in namespaces()
    assert list(tmp_path.iterdir()) == []
    running = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    assert str(tmp_path) not in running
