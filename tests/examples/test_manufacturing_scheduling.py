"""The manufacturing example's schedulers, the integer program, the bound and the criteria."""

import numpy as np
import pytest
from manufacturing.core.orders import SETUP_S, Scenario
from manufacturing.core.simulation import simulate
from manufacturing.criteria import FLEETS, judge
from manufacturing.scheduling import SCHEDULERS, scheduler
from manufacturing.scheduling.bound import makespan_bound
from manufacturing.scheduling.integer_program import Lot, Slot, divide, loads

SMALL = {"orders": 9, "fraction": 0.3}


@pytest.mark.parametrize("name", SCHEDULERS)
@pytest.mark.parametrize("kind", ["normal", "anomalies", "ppe"])
def test_every_job_is_printed_well_exactly_once(name, kind):
    """Whatever the scheduler, no job is lost, and a job is printed again only after it came to nothing."""
    scenario = Scenario(name=kind, seed=4, machines=4, **SMALL)
    outcome = simulate(scenario, scheduler(name))
    good = [r.task.job for records in outcome.prints.values() for r in records if r.result == "Finished"]
    assert sorted(good) == sorted((order.id, n) for order in scenario.book() for n in range(order.jobs))
    for records in outcome.prints.values():
        ends = [record.cleaned for record in records]
        assert all(record.started >= end for record, end in zip(records[1:], ends, strict=False))
    tries = sorted(r.task.name for records in outcome.prints.values() for r in records)
    assert len(set(tries)) == len(tries)
    if kind == "normal":
        assert outcome.makespan >= makespan_bound(scenario, 5.0).seconds


@pytest.mark.parametrize("name", SCHEDULERS)
def test_a_schedule_is_the_same_each_time(name):
    """One seed, one schedule: integer programs end by nodes, not by the clock."""
    scenario = Scenario(name="anomalies", seed=5, machines=3, **SMALL)
    assert simulate(scenario, scheduler(name)) == simulate(scenario, scheduler(name))


def test_decentralized_keeps_an_order_on_one_printer():
    """Each order is printed by a single machine, even if others stand idle."""
    outcome = simulate(Scenario(name="normal", seed=4, machines=12, **SMALL), scheduler("decentralized"))
    of_order = {}
    for machine, records in outcome.prints.items():
        for record in records:
            of_order.setdefault(record.task.order, set()).add(machine)
    assert {len(machines) for machines in of_order.values()} == {1}


def test_the_program_divides_all_jobs_at_least_as_well_as_by_hand():
    """Two kinds and three printers: loads are those of the division, and the best one is found."""
    lots = [Lot(kind=0, jobs=6, seconds=3_600.0), Lot(kind=5, jobs=3, seconds=3_600.0)]
    slots = [Slot(0.0, 5), Slot(0.0, -1), Slot(0.0, -1)]
    found = divide(lots, slots, SETUP_S)
    assert found.jobs.sum(axis=1).tolist() == [6, 3]
    ends = loads(found.jobs, lots, slots, SETUP_S)
    assert sorted(ends.tolist()) == [10_800.0, 12_000.0, 12_000.0]  # kind 5 stays where it is set up


def test_the_bound_is_exact_where_nothing_can_be_divided():
    """One order of one job on one printer: setup, printing and clean-up."""
    scenario = Scenario(name="normal", seed=2, machines=1, orders=3, fraction=0.01)
    bound = makespan_bound(scenario, 5.0)
    outcome = simulate(scenario, scheduler("dynamic"))
    assert bound.optimal
    assert 0.5 * outcome.makespan < bound.seconds <= outcome.makespan


def test_criteria_are_held_and_broken_by_the_figures():
    """All hold for a good Dynamic; a bad one breaks each of them."""
    seeds = range(3)

    def cells(dynamic):
        return {
            (kind, name, n): {s: (dynamic if name == "dynamic" else 1.0) * (100 + s) for s in seeds}
            for kind in ("normal", "anomalies", "ppe")
            for name in SCHEDULERS
            for n in FLEETS
        }

    bounds = {seed: 0.55 * (100 + seed) for seed in seeds}
    assert all(one.held for one in judge(cells(0.6), cells(0.6), bounds))
    assert not any(one.held for one in judge(cells(1.1), cells(1.1), bounds))
    assert np.isclose(judge(cells(0.6), cells(0.6), bounds)[0].figures["20"].mean, 0.6)
