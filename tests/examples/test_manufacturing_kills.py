"""Processes of a run are killed in its middle: no job is lost, none is printed twice without need."""

import os
import signal

import pytest
from manufacturing.core.orders import Scenario
from manufacturing.running.processes import ProcessProduction

from sdnator.testing.waiting import wait_for

SCENARIO = Scenario(name="anomalies", seed=4, machines=2, orders=4, fraction=0.1)


def without_need(prints):
    """Attempts at a job that had been printed well before, or was printed twice at a time."""
    good = [
        record.task.job for records in prints.values() for record in records if record.result == "Finished"
    ]
    return len(good) - len(set(good))


@pytest.mark.timeout(400)
def test_killed_scheduler_twins_and_driver_lose_no_job():
    """Each of the three is killed -9 in turn, at a step of its own; all jobs are printed well exactly once."""
    with ProcessProduction(SCENARIO, "dynamic", patience_s=300.0) as production:
        watcher = production.watcher
        for number, app in enumerate(("scheduler", "digital_twins", "data_driver")):
            watcher.wait_step(4 + 6 * number, 120)
            before, step = production.pid(app), watcher.step
            os.kill(before, signal.SIGKILL)
            wait_for(
                lambda app=app, before=before: production.pid(app) != before, 90, lambda: production.told
            )
            watcher.wait_step(step + 3, 120)
        watcher.wait_done(120, 300)
        prints = watcher.prints()
    jobs = {(order.id, number) for order in SCENARIO.book() for number in range(order.jobs)}
    good = {r.task.job for records in prints.values() for r in records if r.result == "Finished"}
    assert good == jobs
    assert without_need(prints) == 0
    attempts = [record.task.name for records in prints.values() for record in records]
    assert len(attempts) == len(set(attempts))
