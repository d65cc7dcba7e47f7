"""The five apps together, over real HTTP and DUE: the same schedule as in the pure simulation."""

import msgspec
import pytest
from manufacturing.core.orders import HOUR, Order, Scenario
from manufacturing.core.printer import STEP_S, Printer
from manufacturing.core.simulation import simulate
from manufacturing.core.twins import FleetState, FleetTwin, MachineState, TriedJob
from manufacturing.data_driver.step_keeper import StepKeeper
from manufacturing.messages import FleetMessage, JobAssignment, PlanMessage
from manufacturing.running.in_process import InProcessProduction
from manufacturing.scheduling import SCHEDULERS, scheduler
from manufacturing.scheduling.backlog import Backlog

MACHINES = {"normal": 3, "anomalies": 1, "ppe": 2}
ORDER = Order(id=0, at=0.0, kind=3, jobs=5, volume=6.0)
FLEET = FleetState(step=7, time=2_100.0, machines=(), done=(), tried=(), maintain=("m01",))


@pytest.mark.parametrize(
    ("kind", "name"),
    [*((kind, name) for kind in ("normal", "anomalies") for name in SCHEDULERS), ("ppe", "dynamic")],
)
def test_rest_and_due_change_no_schedule(kind, name):
    """One seed of each scenario and scheduler: every print on the same machine at the same time."""
    scenario = Scenario(name=kind, seed=4, machines=MACHINES[kind], orders=3, fraction=0.05)
    with InProcessProduction(scenario, name) as production:
        production.watcher.wait_done(60, 120)
        prints = production.watcher.prints()
        health = {app: service.health() for app, service in production.services.items()}
    assert prints == simulate(scenario, scheduler(name)).prints
    assert health["data_driver"]["unplanned"] == 0
    assert health["scheduler"]["orders"] == len(scenario.book())


def test_a_step_is_carried_out_when_all_of_one_plan_is_there():
    """Parts of another plan, of another step, or a plan without its fleet carry out nothing."""
    keeper = StepKeeper(7)
    tasks = (ORDER.task(0),)
    keeper.assignment("m00", JobAssignment("r", 7, "old", tasks))
    keeper.assignment("m01", JobAssignment("r", 6, "new", tasks))
    keeper.plan(PlanMessage("r", 7, "new", ("m00", "m01")))
    assert keeper.fleet(FleetMessage("r", FLEET)) == ("m01",)
    assert keeper.complete() is None
    keeper.assignment("m00", JobAssignment("r", 7, "new", tasks))
    assert keeper.complete() is None
    keeper.assignment("m01", JobAssignment("r", 7, "new", ()))
    assert keeper.complete() == {"m00": tasks, "m01": ()}
    keeper.next()
    assert keeper.complete() is None


def test_a_print_that_is_about_to_be_aborted_is_an_attempt():
    """Printers refuse a job of the same name as the one that they are still printing."""
    running = MachineState(
        machine="m01", status="printing", loaded=3, free_at=0.0, finish=0.0, running=ORDER.task(1, 1), queue=(),
        waited=0.0, prints=1, alarm="a part was found ruined",
    )  # fmt: skip
    fleet = msgspec.structs.replace(FLEET, machines=(running,), tried=(TriedJob(0, 1, 1, "m01"),))
    assert [(machine, task.name) for machine, task in Backlog([ORDER], fleet).again()] == [
        ("m01", ORDER.task(1, 2).name)
    ]


def test_maintenance_is_ordered_once_also_by_a_late_fleet():
    """A fleet that comes twice, or after its step, has its machines maintained exactly once."""
    keeper = StepKeeper(9)
    message = FleetMessage("r", FLEET)
    assert [keeper.fleet(message), keeper.fleet(message)] == [("m01",), ()]


def test_twins_that_begin_anew_order_a_maintenance_that_nobody_carried_out():
    """Twins killed between alarm and order: the next ones find the alarm in the archive, and order it again."""
    printer, reports = Printer(0, 3, faulty=True), []
    first = FleetTwin(["m00"], 3, sensors=True)
    for number in range(1_000):
        printer.enqueue(Order(id=0, at=0.0, kind=0, jobs=1_000, volume=5.0).task(number))
    for step in range(round(400 * HOUR / STEP_S)):
        printer.advance(step * STEP_S)
        reports.append(printer.report(step))
        if first.update(reports[-1:]).maintain:
            break
    second = FleetTwin(["m00"], 3, sensors=True)
    second.restore(reports)
    printer.advance(printer.time + STEP_S)
    assert second.update([printer.report(step + 1)]).maintain == ("m00",)
    printer.advance(printer.time + STEP_S)
    assert second.update([printer.report(step + 2)]).maintain == ()
