"""Orders, printers, sensors, twins: the manufacturing example's pure parts."""

import numpy as np
import pytest
from manufacturing.core import faults, process, simulation
from manufacturing.core.anomaly import AnomalyDetector, commissioning_prints
from manufacturing.core.orders import HOUR, Order, Scenario
from manufacturing.core.printer import MOST_QUEUED, STEP_S, Printer, QueueFull
from manufacturing.core.simulation import reconcile
from manufacturing.core.twins import FleetTwin
from manufacturing.scheduling import SCHEDULERS, scheduler

ORDER = Order(id=0, at=0.0, kind=3, jobs=5, volume=6.0)


def printed(printer: Printer, hours: float) -> list:
    """Reports up to so many hours."""
    reports = []
    for step in range(round(hours * HOUR / STEP_S)):
        printer.advance(step * STEP_S)
        reports.append(printer.report(step))
    return reports


def test_orders_of_a_seed_are_the_same_for_every_fleet():
    """Schedulers and fleets meet the same orders; another seed brings others; all jobs come by the end of the day."""
    one = Scenario(name="normal", seed=1, machines=5).book()
    assert one == Scenario(name="anomalies", seed=1, machines=40).book()
    assert one != Scenario(name="normal", seed=2, machines=5).book()
    assert [order.at for order in one] == sorted(order.at for order in one)
    urgent = [order for order in Scenario(name="ppe", seed=1, machines=5).book() if order.priority]
    assert [order.at for order in urgent] == [4 * HOUR, 6 * HOUR]


def test_a_print_takes_setup_heat_up_printing_and_clean_up():
    """The first print of a kind is set up for, the second is not; times are those of the process."""
    printer = Printer(0, 1, faulty=False)
    for number in range(2):
        printer.enqueue(ORDER.task(number))
    printed(printer, 4)
    first, second = printer.history
    assert first.setup == process.setup_s(3, -1)
    assert second.setup == 0
    heat = process.heat_up_s(process.AMBIENT_C, 215.0)
    assert first.finished == pytest.approx(first.setup + heat + process.printing_s(1, first.task), abs=0.1)
    assert second.started == first.cleaned == pytest.approx(first.finished + process.CLEAN_UP_S)
    assert {first.result, second.result} == {"Finished"}


def test_how_often_time_is_advanced_changes_no_print():
    """History depends on simulated time only."""
    often, seldom = Printer(0, 1, faulty=True), Printer(0, 1, faulty=True)
    for printer in (often, seldom):
        for number in range(5):
            printer.enqueue(ORDER.task(number))
    printed(often, 10)
    seldom.advance(often.time)
    assert often.history == seldom.history


def test_a_fault_shows_in_the_sensors_before_it_ruins_the_print():
    """Every kind of fault raises an alarm between its beginning and the ruin; a printer without one raises none."""
    for machine in range(6):
        good = AnomalyDetector(commissioning_prints(1, machine))
        healthy = faults.readings(1, machine, 7, np.arange(1, 2_000) * 30.0, None)
        assert good.alarm([tuple(row) for row in healthy.tolist()]) == ""
        for kind in ("clog", "heater", "slip"):
            fault = faults.PrinterFault(kind, 3_000.0, 3_900.0)
            at = np.arange(1, 200) * 30.0
            rows = faults.readings(1, machine, 8, at, fault).tolist()
            detector = AnomalyDetector(commissioning_prints(1, machine))
            found = next(t for t, row in zip(at, rows, strict=True) if detector.alarm([tuple(row)]))
            assert fault.onset < found < fault.ruin, (kind, machine)


def test_a_fault_ruins_prints_until_maintenance():
    """After the ruin every print fails; maintenance ends that, and the job is tried again by another attempt."""
    printer = Printer(2, 3, faulty=True)
    for number in range(4_000):
        printer.enqueue(Order(id=0, at=0.0, kind=0, jobs=4_000, volume=5.0).task(number))
    while printer.ruined < 2:
        printer.advance(printer.time + STEP_S)
    assert [record.result for record in printer.history[-2:]] == ["Failed", "Failed"]
    printer.maintain()
    printer.abort()
    ended = len(printer.history)
    printer.advance(printer.time + 3 * HOUR)
    assert {record.result for record in printer.history[ended + 1 :]} == {"Finished"}


def test_a_full_queue_refuses_jobs():
    """A printer bounds its queue and says so."""
    printer = Printer(0, 1, faulty=False)
    for number in range(MOST_QUEUED):
        printer.enqueue(ORDER.task(number))
    with pytest.raises(QueueFull, match="4096 jobs wait already"):
        printer.enqueue(ORDER.task(0, 1))


def test_twins_know_state_queue_and_expected_finish():
    """The twin expects the end of the queue within a tenth of what it turns out to be."""
    printer = Printer(0, 1, faulty=False)
    twins = FleetTwin(["m00"], 1, sensors=True)
    for number in range(5):
        printer.enqueue(ORDER.task(number))
    printer.advance(STEP_S)
    state = twins.update([printer.report(1)]).machines[0]
    assert (len(state.queue), state.running, state.status) == (4, ORDER.task(0), "printing")
    for step in range(2, 100):
        printer.advance(step * STEP_S)
        last = twins.update([printer.report(step)])
    assert len(last.done) == 5
    assert state.finish == pytest.approx(printer.history[-1].cleaned, rel=0.1)
    assert last.machines[0].waited > 0


def test_twins_have_a_faulty_printer_maintained_and_the_job_printed_again():
    """The alarm comes before the ruin; the aborted job is neither done nor lost: it counts as tried."""
    printer = Printer(0, 3, faulty=True)
    twins = FleetTwin(["m00"], 3, sensors=True)
    for number in range(1_000):
        printer.enqueue(Order(id=0, at=0.0, kind=0, jobs=1_000, volume=5.0).task(number))
    step, fleet = 0, None
    while fleet is None or not fleet.maintain:
        step += 1
        printer.advance(step * STEP_S)
        fleet = twins.update([printer.report(step)])
    assert printer.broken
    assert printer.abort()
    printer.maintain()
    while printer.status != "maintenance":
        step += 1
        printer.advance(step * STEP_S)
        fleet = twins.update([printer.report(step)])
    assert not printer.ruined
    assert [one.attempts for one in fleet.tried] == [1]


@pytest.mark.parametrize("name", SCHEDULERS)
def test_no_printer_is_given_a_name_that_it_had_before(name):
    """Printers refuse such a job: also the plan of a job that has failed since names the next attempt."""
    scenario = Scenario(name="anomalies", seed=0, machines=3, orders=20, fraction=0.3)
    asked = []

    class Watched(Printer):
        def knows(self, task):
            known = super().knows(task)
            asked.append(known)
            return known

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulation, "Printer", Watched)
        found = simulation.simulate(scenario, scheduler(name))
    assert found.aborted + found.ruined
    assert not any(asked)


def test_a_queue_is_brought_to_what_is_wanted():
    """Only what differs is withdrawn and added; an order that differs is put right."""
    a, b, c = (ORDER.task(number) for number in range(3))
    assert reconcile([a, b], [a, b]) == ([], [])
    assert reconcile([a, b], [b, c]) == ([a.name], [(1, c)])
    assert reconcile([a, b], [b, a]) == ([a.name, b.name], [(0, b), (1, a)])
