"""A prediction is compared with what was used while packets came."""

import msgspec
import pytest

from benchmarks.cluster_plan import compared, mean_of
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
TWO_RATES = {"kitsune": ProcessCost(us_per_packet=(90.0, 80.0))}
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


def test_a_slower_machine_needs_more_for_the_same():
    """The reference work takes a fifth longer while two switches are measured, and so do the packets."""
    costs = msgspec.structs.replace(COSTS, reference_us=1000.0)
    idle = LoadPhase(
        elapsed_s=10, cpu_s={"kitsune": 0.12, "switch": 0.48}, archived=0, reference_us=1200, **NOTHING
    )
    used = {"kitsune": 1.2 + 0.144, "switch": 0.6 + 0.576}
    slow = LoadPhase(
        elapsed_s=12, load_s=10, sent=10_000, cpu_s=used, archived=4_000_000, reference_us=1200, **NOTHING
    )
    found = compared(2, idle, slow, costs)
    assert found.errors["cores"] == pytest.approx(0, abs=1e-9)
    assert found.unscaled_error == pytest.approx(1 - 1 / 1.2)


def test_two_measurements_of_one_switch_are_averaged_at_one_speed():
    """The second was made while the machine was half as fast."""
    first = msgspec.structs.replace(COSTS, reference_us=1000.0)
    slow = {
        name: msgspec.structs.replace(
            cost,
            idle_cores=2 * cost.idle_cores,
            us_per_packet=tuple(2 * each + 20 for each in cost.us_per_packet),
        )
        for name, cost in COSTS.processes.items()
    }
    found = mean_of(first, msgspec.structs.replace(first, processes=slow, reference_us=2000.0))
    assert found.reference_us == 1000
    assert found.processes["kitsune"].us_per_packet == pytest.approx((105,))
    assert found.processes["switch"].idle_cores == pytest.approx(0.02)
    more = msgspec.structs.replace(COSTS, rates=(100.0, 500.0), archive=(500.0, 400.0), processes=TWO_RATES)
    assert mean_of(first, more) is more
