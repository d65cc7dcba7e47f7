"""A prediction is compared with what was used while packets came."""

import pytest

from benchmarks.cluster_plan import compared
from sdnator.plan.costs import Costs, ProcessCost
from sdnator.plan.measured_pipeline import LoadPhase

COSTS = Costs(
    machine="some processor",
    cores=2,
    measured="2026-11-25",
    rates=(500.0,),
    processes={
        "kitsune": ProcessCost(idle_cores=0.01, us_per_packet=(100.0,)),
        "switch": ProcessCost(per_switch=True, idle_cores=0.02, us_per_packet=(50.0,)),
    },
    archive=(400.0,),
)
NOTHING = {"updates_in": 0, "updates_out": 0}
IDLE = LoadPhase(elapsed_s=10, cpu_s={"kitsune": 0.1, "switch": 0.4}, archived=0, **NOTHING)


def busy(kitsune, switch, archived):
    """Ten seconds of load at two switches, and two until all was scored."""
    used = {"kitsune": kitsune + 0.12, "switch": switch + 0.48}
    return LoadPhase(elapsed_s=12, load_s=10, sent=10_000, cpu_s=used, archived=archived, **NOTHING)


def test_what_is_as_predicted_has_no_error():
    found = compared(2, IDLE, busy(1.0, 0.5, 4_000_000), COSTS)
    assert found.by_process["kitsune"] == (pytest.approx(0.11), pytest.approx(0.11))
    assert found.by_process["switch"] == (pytest.approx(0.09), pytest.approx(0.09))
    assert found.errors == {"cores": pytest.approx(0, abs=1e-9), "gb_per_day": pytest.approx(0, abs=1e-9)}


def test_errors_are_relative_to_what_was_measured():
    """A pipeline that uses a fifth less than predicted, and archives twice as much."""
    found = compared(2, IDLE, busy(0.7, 0.4, 8_000_000), COSTS)
    assert found.cores == pytest.approx(0.16)
    assert found.errors == {"cores": pytest.approx(0.25), "gb_per_day": pytest.approx(0.5)}
