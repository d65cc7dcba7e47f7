"""The pipeline that `sdnator up` keeps running: started in order, parts that die started again.

    Valkey, or a given server ─ coordinator ─┬─ switch ◄─ P4Runtime ─ p4runtime_ctrl
    SQLite, or a given archive               ├─ kitsune
                                             ├─ sonata_adapter
                                             └─ firewall

Coordinator and apps rebuild their state from the others and from the archive, so each may be started
again alone.  The switch may not: its clock begins anew, and every timer with it.
"""

import json
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from dataplane.bmv2 import Bmv2, Bmv2Error
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_wire import Wire
from due.errors import DueError, InvalidOption, UpdatesUnavailable
from sdnator import p4_program
from sdnator.errors import BadInput, PipelineError
from sdnator.held_signals import held_signals
from sdnator.process import Child

SWITCH_NAME = "s1"
APPS = ("p4runtime_ctrl", "kitsune", "sonata_adapter", "firewall")
DEATHS, DEATHS_SECONDS = 3, 60.0
"""A part that dies more often than so many times in so many seconds ends the pipeline."""
_UPDATES_SECONDS = 1.0


@dataclass(frozen=True, kw_only=True)
class StandingPlan:
    """What to keep running."""

    state: Path
    """Folder for logs, settings, spools and the embedded Data Updates server."""
    updates: str = ""
    """Data Updates URL; empty: an embedded server."""
    archive: str
    """Data Archives URL."""
    switch: str = "embedded"
    """embedded, bmv2, or HOST:PORT of a P4Runtime switch that runs already."""
    device_id: int = 1
    ports: Mapping[int, str] = field(default_factory=dict)
    """Port number to `veth:INTERFACE` or `null`, for a switch that we start."""
    forward: Mapping[int, int] = field(default_factory=dict)
    """Ingress port to egress port."""
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Of coordinator, kitsune, sonata_adapter and firewall, by name."""


class StandingPipeline:
    """A running pipeline; a context manager.  `tell` gets a line for each part that is started again.

    Raises:
        BadInput: for a Data Updates URL that is none.
        PipelineError: from entering and `watch`, naming the part and its last words.
    """

    def __init__(self, plan: StandingPlan, tell: Callable[[str], None]) -> None:
        self._plan = plan
        self._tell = tell
        self._stack = ExitStack()
        self._logs = plan.state / "logs"
        self._children: dict[str, Child] = {}
        self._commands: dict[str, tuple[str, ...]] = {}
        self._deaths: dict[str, deque[float]] = {}
        self._server: EmbeddedServer | None = None
        self._looked = time.monotonic()
        self.updates = plan.updates
        self.coordinator = ""
        """URL of the Coordinator's HTTP API."""
        self.switch_address = ""

    def __enter__(self) -> Self:
        try:
            self._start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def logs(self) -> Path:
        """Where each part writes its log; the last run's are kept beside them."""
        return self._logs

    def pids(self) -> dict[str, int]:
        """Process ids by name."""
        found = {name: child.pid for name, child in self._children.items()}
        return ({"updates": self._server.pid} if self._server is not None else {}) | found

    def _start(self) -> None:
        self._logs.mkdir(mode=0o700, parents=True, exist_ok=True)
        for log in self._logs.glob("*.log"):
            log.replace(log.with_suffix(".log.1"))
        self._start_updates()
        address_file = self._plan.state / "coordinator.url"
        address_file.unlink(missing_ok=True)
        coordinator = self._app(
            "coordinator",
            "coordinator.service",
            {**self._settings("coordinator"), "address_file": str(address_file)},
        )
        base_us = self._start_switch()
        coordinator.wait_ready()
        self.coordinator = address_file.read_text(encoding="utf-8")
        started = [
            self._app(name, f"apps.{name}.service", self._app_settings(name, base_us)) for name in APPS
        ]
        for app in started:
            app.wait_ready()

    def _start_updates(self) -> None:
        try:
            if self.updates:
                Wire(self.updates).close()
            else:
                with held_signals():
                    self._server = self._stack.enter_context(EmbeddedServer(self._fresh_folder()))
                self.updates = self._server.url
        except InvalidOption as error:
            raise BadInput(f"--updates: {error}") from None
        except DueError as error:
            raise PipelineError(str(error)) from None

    def _fresh_folder(self) -> Path:
        """Another one for each run: what a killed run left behind, still ending, must not find our server."""
        for old in self._plan.state.glob("updates-*"):
            shutil.rmtree(old, ignore_errors=True)
        return self._plan.state / f"updates-{os.getpid()}"

    def _start_switch(self) -> int:
        """Its address is noted; returns the absolute time of its clock's zero, µs."""
        if self._plan.switch == "embedded":
            ports = [
                part for number, kind in self._plan.ports.items() for part in ("--port", f"{number}={kind}")
            ]
            switch = self._child(
                "switch",
                "dataplane",
                "--grpc",
                "127.0.0.1:0",
                "--device-id",
                str(self._plan.device_id),
                *ports,
            )
            self.switch_address = str(switch.wait_ready()["grpc"])
        elif self._plan.switch == "bmv2":
            began_us = time.time_ns() // 1_000
            interfaces = {number: kind.removeprefix("veth:") for number, kind in self._plan.ports.items()}
            try:
                with held_signals():
                    bmv2 = self._stack.enter_context(Bmv2(interfaces, device_id=self._plan.device_id))
            except Bmv2Error as error:
                raise PipelineError(str(error)) from None
            self.switch_address = bmv2.address
            return began_us
        else:
            self.switch_address = self._plan.switch
        return time.time_ns() // 1_000

    def _app_settings(self, name: str, base_us: int) -> Mapping[str, Any]:
        if name != "p4runtime_ctrl":
            return self._settings(name)
        program = p4_program.find()
        return {
            "program": str(program.bmv2_json),
            "p4info": str(program.p4info),
            "switches": [
                {
                    "name": SWITCH_NAME,
                    "address": self.switch_address,
                    "device_id": self._plan.device_id,
                    "base_us": base_us,
                    "target": self._plan.switch,
                    "forward": {str(number): egress for number, egress in self._plan.forward.items()},
                }
            ],
        }

    def _settings(self, name: str) -> Mapping[str, Any]:
        return self._plan.settings.get(name, {})

    def _app(self, name: str, module: str, settings: Mapping[str, Any]) -> Child:
        path = self._plan.state / f"{name}.settings.json"
        path.write_text(json.dumps(settings, indent=2), encoding="utf-8")
        directory = str(self._plan.state / "due" / name)
        places = ("--updates", self.updates, "--archive", self._plan.archive, "--directory", directory)
        return self._child(name, module, *places, "--settings", str(path))

    def _child(self, name: str, *arguments: str) -> Child:
        self._commands[name] = arguments
        with held_signals():
            child = self._children[name] = Child(name, arguments, self._logs)
        return child

    def watch(self) -> bool:
        """Start again what has died; True where that happened.  To be called every now and then."""
        restarted = self._watch_updates()
        for name in list(self._children):
            try:
                self._children[name].check()
            except PipelineError as error:
                self._start_again(name, error)
                restarted = True
        return restarted

    def _start_again(self, name: str, error: PipelineError) -> None:
        if name == "switch":
            raise error
        self._count_death(name, error)
        self._children[name].stop()
        # it may have taken the server along, and needs one to start
        self._looked = float("-inf")
        self._watch_updates()
        self._child(name, *self._commands[name]).wait_ready()
        if name == "coordinator":
            self.coordinator = (self._plan.state / "coordinator.url").read_text(encoding="utf-8")
        self._tell(f"{str(error).partition(chr(10))[0].removesuffix('; its last words:')}: started again")

    def _count_death(self, name: str, error: PipelineError) -> None:
        now = time.monotonic()
        deaths = self._deaths.setdefault(name, deque(maxlen=DEATHS + 1))
        deaths.append(now)
        if len(deaths) > DEATHS and now - deaths[0] < DEATHS_SECONDS:
            raise PipelineError(f"{name} dies again and again: {error}")

    def _watch_updates(self) -> bool:
        """What was published while it was away is sent again by its producers."""
        now = time.monotonic()
        if self._server is None or now - self._looked < _UPDATES_SECONDS:
            return False
        self._looked = now
        try:
            Wire(self._server.url).close()
        except UpdatesUnavailable as error:
            self._count_death("updates", PipelineError(str(error)))
            self._server.kill()
            try:
                with held_signals():
                    self._server.start()
            except UpdatesUnavailable as again:
                raise PipelineError(str(again)) from None
            self._tell("Data Updates server had ended: started again")
            return True
        return False

    def stop(self) -> None:
        """Stop all parts, the last started first."""
        while self._children:
            self._children.popitem()[1].stop()
        self._stack.close()
