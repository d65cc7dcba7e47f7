"""The five apps as processes under a supervisor, with a Valkey and a Coordinator: a run that survives kills.

Valkey ─► coordinator ─► machine_assets, job_creator, scheduler, digital_twins, data_driver
"""

import tempfile
import threading
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

import msgspec

from due import Options
from due.drivers.embedded_redis import EmbeddedServer
from manufacturing.core.orders import Scenario
from manufacturing.running.in_process import APPS, settings_of
from manufacturing.running.watcher import Watcher
from manufacturing.scheduling import SchedulerName
from manufacturing.scheduling.integer_program import SECONDS
from sdnator.supervisor import Child, PartSpec, Supervisor

PACKAGE: Final = Path(__file__).resolve().parent.parent.parent
_LOOK_S: Final = 0.1
_HUNG_S: Final = SECONDS + 50.0
"""An integer program may take `SECONDS`, in which the scheduler hears nothing."""


class ProcessProduction:
    """A run of a scenario; a context manager.

    Args:
        scenario: what is to be printed on which fleet.
        name: of the scheduler.
        speed_up: simulated seconds in a second at most; 0: without limit.
        patience_s: seconds after which the driver lets time pass without a plan.
    """

    def __init__(
        self, scenario: Scenario, name: SchedulerName, *, speed_up: float = 0.0, patience_s: float = 120.0
    ) -> None:
        self._scenario = scenario
        self._settings = settings_of(scenario, name, speed_up)
        self._settings["data_driver"]["patience_s"] = patience_s
        self._stack = ExitStack()
        self._ended = threading.Event()
        self.told: list[str] = []
        """What the supervisor had to say: deaths and restarts."""

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="manufacturing-")))
            server = stack.enter_context(EmbeddedServer(self._folder / "updates"))
            archive = f"sqlite://{self._folder / 'archive.db'}"
            self._backends = ("--updates", server.url, "--archive", archive)
            parts = [
                PartSpec(name="coordinator", start=partial(self._child, "coordinator", "coordinator.service"))
            ]
            parts += [
                PartSpec(
                    name=app,
                    start=partial(self._child, app, module.__name__),
                    after=("coordinator",),
                    silence_s=_HUNG_S,
                )
                for app, module, _ in APPS
            ]
            self._supervisor = stack.enter_context(Supervisor(tuple(parts), self.told.append))
            self._supervisor.start()
            options = Options(updates=server.url, archive=archive, directory=str(self._folder / "watcher"))
            self.watcher = stack.enter_context(Watcher(options, self._scenario))
            keeper = threading.Thread(target=self._keep, name="supervisor", daemon=True)
            keeper.start()
            stack.callback(keeper.join)
            stack.callback(self._ended.set)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def pid(self, app: str) -> int:
        """Process id of an app."""
        return self._supervisor.pids()[app]

    def _child(self, name: str, module: str) -> Child:
        command = [module, *self._backends, "--directory", str(self._folder / name), "--log", "warning"]
        settings: dict[str, Any] = self._settings.get(name, {})
        file = self._folder / f"{name}.json"
        file.write_bytes(msgspec.json.encode(settings))
        # no installation is needed: the package lies beside the product
        return Child(
            name,
            [*command, "--settings", str(file)],
            self._folder,
            heartbeat=name != "coordinator",
            environment={"PYTHONPATH": str(PACKAGE)},
        )

    def _keep(self) -> None:
        while not self._ended.is_set():
            self._supervisor.watch()
            self._supervisor.wait(_LOOK_S)
