"""All five apps in this process over memory://, with real HTTP between driver and printers."""

import itertools
import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from types import ModuleType
from typing import Any, Final, Self

import msgspec

from due import Engine, Options
from due.service import TICK_SECONDS, Service
from manufacturing import scheduling
from manufacturing.core.orders import Scenario
from manufacturing.data_driver import service as data_driver
from manufacturing.digital_twins import service as digital_twins
from manufacturing.job_creator import service as job_creator
from manufacturing.job_scheduler import service as job_scheduler
from manufacturing.machine_assets import service as machine_assets
from manufacturing.running.watcher import Watcher
from manufacturing.scheduling import SchedulerName

APPS: Final[tuple[tuple[str, ModuleType, str], ...]] = (
    ("machine_assets", machine_assets, "MachineAssetsService"),
    ("job_creator", job_creator, "JobCreatorService"),
    ("scheduler", job_scheduler, "JobSchedulerService"),
    ("digital_twins", digital_twins, "DigitalTwinsService"),
    ("data_driver", data_driver, "DataDriverService"),
)
"""App id, module and class, in the order in which they are started; stopped the other way round."""
_numbers: Iterator[int] = itertools.count()


def settings_of(scenario: Scenario, name: SchedulerName, speed_up: float = 0.0) -> dict[str, dict[str, Any]]:
    """The settings of each app for a scenario and a scheduler."""
    sensors = scheduling.scheduler(name).sensors
    where = {"scenario": scenario.name, "seed": scenario.seed, "machines": scenario.machines}
    return {
        "machine_assets": {**where, "speed_up": speed_up},
        "data_driver": {"readings": sensors},
        "digital_twins": {"seed": scenario.seed, "sensors": sensors},
        "job_creator": {**where, "orders": scenario.orders, "fraction": scenario.fraction},
        "scheduler": {"scheduler": name},
    }


class InProcessProduction:
    """A run of a scenario; a context manager.

    Args:
        scenario: what is to be printed on which fleet.
        name: of the scheduler.
        speed_up: simulated seconds in a second at most; 0: without limit.
    """

    def __init__(self, scenario: Scenario, name: SchedulerName, *, speed_up: float = 0.0) -> None:
        self._scenario = scenario
        self._settings = settings_of(scenario, name, speed_up)
        self._stack = ExitStack()
        self._stopping = threading.Event()
        self.services: dict[str, Service] = {}

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="manufacturing-"))
            url = f"memory://manufacturing-{os.getpid()}-{next(_numbers)}"
            options = Options(coordinated=False, directory=folder, updates=url, archive=url)
            self.watcher = stack.enter_context(Watcher(options, self._scenario))
            for app, module, service in APPS:
                engine = Engine(options)
                engine.init(app, interests=module.INTERESTS, capabilities=module.CAPABILITIES)
                stack.callback(engine.close)
                settings = msgspec.convert(self._settings[app], module.Settings)
                self.services[app] = getattr(module, service)(engine, settings)
                self.services[app].start()
                stack.callback(self.services[app].stop)
            ticker = threading.Thread(target=self._tick, name="apps-ticks", daemon=True)
            ticker.start()
            stack.callback(ticker.join)
            stack.callback(self._stopping.set)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _tick(self) -> None:
        while not self._stopping.wait(TICK_SECONDS):
            for service in self.services.values():
                service.tick()
