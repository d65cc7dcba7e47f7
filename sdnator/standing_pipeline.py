"""The pipeline that `sdnator up` keeps running: started in order, parts that die started again.

    Valkey, or a given server ─ coordinator ─┬─ switches ◄─ P4Runtime ─ p4runtime_ctrl
    SQLite, or a given archive               ├─ kitsune
                                             ├─ sonata_adapter
                                             ├─ firewall
                                             └─ dashboard

Coordinator and apps rebuild their state from the others and from the archive, so each may be started
again alone.  A switch may not: its clock begins anew, and every timer with it.
"""

import json
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Self

import msgspec

from dataplane.bmv2 import Bmv2, Bmv2Error
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_wire import Wire
from due.errors import DueError, InvalidOption, UpdatesUnavailable
from sdnator import p4_program
from sdnator.errors import BadInput, PipelineError
from sdnator.held_signals import held_signals
from sdnator.planned_switches import PlannedSwitch
from sdnator.process import Child
from sdnator.standing_plan import APPS, StandingPlan, changes, taken_up

DEATHS, DEATHS_SECONDS = 3, 60.0
"""A part that dies more often than so many times in so many seconds ends the pipeline."""
_UPDATES_SECONDS = 1.0


class StandingPipeline:
    """A running pipeline; a context manager.  `tell` gets a line for each part that is started again.

    Raises:
        BadInput: for a Data Updates URL that is none.
        PipelineError: from entering and `watch`, naming the part and its last words.
    """

    def __init__(self, plan: StandingPlan, tell: Callable[[str], None]) -> None:
        self.plan = plan
        self._tell = tell
        self._stack = ExitStack()
        self._logs = plan.state / "logs"
        self._children: dict[str, Child] = {}
        self._commands: dict[str, tuple[str, ...]] = {}
        self._ready: dict[str, dict[str, Any]] = {}
        self._deaths: dict[str, deque[float]] = {}
        self._server: EmbeddedServer | None = None
        self._looked = time.monotonic()
        self._address_file = plan.state / "coordinator.url"
        self._bases: dict[str, int] = {}
        self.updates = plan.updates
        self.coordinator = ""
        """URL of the Coordinator's HTTP API."""
        self.switch_addresses: dict[str, str] = {}
        """Of the P4Runtime servers, by switch."""

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

    def pids(self) -> dict[str, int]:
        """Process ids by name."""
        found = {name: child.pid for name, child in self._children.items()}
        return ({"updates": self._server.pid} if self._server is not None else {}) | found

    def endpoints(self, what: str) -> dict[str, str]:
        """Addresses that parts told when they were ready, by part: `metrics`, `http`."""
        return {name: str(said[what]) for name, said in self._ready.items() if said.get(what)}

    @property
    def dashboard(self) -> str:
        """URL of the page; empty where there is none."""
        return self.endpoints("dashboard").get("dashboard", "")

    def _start(self) -> None:
        self._logs.mkdir(mode=0o700, parents=True, exist_ok=True)
        for log in self._logs.glob("*.log"):
            log.replace(log.with_suffix(".log.1"))
        self._address_file.unlink(missing_ok=True)
        self._start_updates()
        self._app("coordinator")
        for switch in self.plan.switches:
            self._start_switch(switch)
        for switch in self.plan.switches:
            self._note_switch(switch)
        self._wait_ready("coordinator")
        for name in APPS:
            self._app(name)
        for name in APPS:
            self._wait_ready(name)
        if self.plan.dashboard is not None:
            self._app("dashboard")
            self._wait_ready("dashboard")

    def _start_updates(self) -> None:
        try:
            if self.updates:
                Wire(self.updates).close()
            else:
                with held_signals():
                    folder = self._fresh_folder()
                    self._server = self._stack.enter_context(EmbeddedServer(folder))
                self.updates = self._server.url
        except InvalidOption as error:
            raise BadInput(f"--updates: {error}") from None
        except DueError as error:
            raise PipelineError(str(error)) from None

    def _fresh_folder(self) -> Any:
        """Another one for each run: what a killed run left behind, still ending, must not find our server."""
        for old in self.plan.state.glob("updates-*"):
            shutil.rmtree(old, ignore_errors=True)
        return self.plan.state / f"updates-{os.getpid()}"

    def _switch_part(self, switch: PlannedSwitch) -> str:
        return "switch" if len(self.plan.switches) == 1 else f"switch-{switch.name}"

    def _start_switch(self, switch: PlannedSwitch) -> None:
        self._bases[switch.name] = time.time_ns() // 1_000
        if switch.kind == "embedded":
            ports = [part for number, kind in switch.ports.items() for part in ("--port", f"{number}={kind}")]
            number = str(switch.device_id)
            places = ("--grpc", "127.0.0.1:0", "--device-id", number)
            self._child(self._switch_part(switch), "dataplane", *places, *ports)
        elif switch.kind == "bmv2":
            interfaces = {number: kind.removeprefix("veth:") for number, kind in switch.ports.items()}
            try:
                with held_signals():
                    bmv2 = self._stack.enter_context(Bmv2(interfaces, device_id=switch.device_id))
            except Bmv2Error as error:
                raise PipelineError(str(error)) from None
            self.switch_addresses[switch.name] = bmv2.address
        else:
            self.switch_addresses[switch.name] = switch.kind

    def _note_switch(self, switch: PlannedSwitch) -> None:
        """Its address, and the absolute time of its clock's zero."""
        if switch.kind == "embedded":
            self.switch_addresses[switch.name] = str(self._wait_ready(self._switch_part(switch))["grpc"])
        if switch.kind != "bmv2":
            self._bases[switch.name] = time.time_ns() // 1_000

    def _settings(self, name: str) -> Mapping[str, Any]:
        own = self.plan.settings_of(name)
        if name == "coordinator":
            return {**own, "address_file": str(self._address_file)}
        if name == "dashboard":
            return {**(self.plan.dashboard or {}), **self._dashboard_places()}
        if name == "p4runtime_ctrl":
            return {**own, **self._controller_places()}
        return own

    def _controller_places(self) -> Mapping[str, Any]:
        program = p4_program.find()
        return {
            "program": str(program.bmv2_json),
            "p4info": str(program.p4info),
            "switches": [
                {
                    "name": switch.name,
                    "address": self.switch_addresses[switch.name],
                    "device_id": switch.device_id,
                    "base_us": self._bases[switch.name],
                    "target": switch.kind,
                    "forward": {str(number): egress for number, egress in switch.forward.items()},
                    "fail": switch.fail,
                    **({"learn": msgspec.to_builtins(switch.learn)} if switch.learn.ports else {}),
                }
                for switch in self.plan.switches
            ],
        }

    def _dashboard_places(self) -> Mapping[str, Any]:
        return {
            "coordinator_file": str(self._address_file),
            "switches": [
                {"name": one.name, "address": self.switch_addresses[one.name], "device_id": one.device_id}
                for one in self.plan.switches
            ],
        }

    def _app(self, name: str) -> None:
        """Start an app of DUE with what the plan has for it."""
        module = {"coordinator": "coordinator.service", "dashboard": "sdnator.dashboard"}
        path = self._written(f"{name}.settings.json", self._settings(name))
        directory = str(self.plan.state / "due" / name)
        options = ["--updates", self.updates, "--archive", self.plan.archive, "--directory", directory]
        options += ["--settings", path, "--log", self.plan.log_level]
        if self.plan.engine:
            options += ["--engine", self._written("engine.json", self.plan.engine)]
        if self.plan.log_format != "console":
            options += ["--log-format", self.plan.log_format]
        if self.plan.metrics_host and name != "coordinator":
            options += ["--metrics", f"{self.plan.metrics_host}:0"]
        self._child(name, module.get(name, f"apps.{name}.service"), *options)

    def _written(self, name: str, values: Mapping[str, Any]) -> str:
        path = self.plan.state / name
        path.write_text(json.dumps(values, indent=2), encoding="utf-8")
        return str(path)

    def _child(self, name: str, *arguments: str) -> Child:
        self._commands[name] = arguments
        with held_signals():
            child = self._children[name] = Child(name, arguments, self._logs)
        return child

    def _wait_ready(self, name: str) -> dict[str, Any]:
        said = self._ready[name] = self._children[name].wait_ready()
        if name == "coordinator":
            self.coordinator = self._address_file.read_text(encoding="utf-8")
        return said

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

    def reload(self, plan: StandingPlan) -> None:
        """Take up what can be taken up of another plan, and tell the rest."""
        found = changes(self.plan, plan)
        self.plan = taken_up(self.plan, plan, found.again)
        for name in found.again:
            self._children[name].stop()
            self._app(name)
            self._wait_ready(name)
        for text in found.waits:
            self._tell(text)
        self._tell(f"started again with new settings: {', '.join(found.again) or 'nothing'}")

    def _start_again(self, name: str, error: PipelineError) -> None:
        if name.startswith("switch"):
            raise error
        try:
            self._count_death(name, error)
        except PipelineError:
            if name != "dashboard":
                raise
            self._children.pop(name).stop()
            del self._ready[name]
            self._tell(f"{_first_line(error)}: again and again, so there is no dashboard any more")
            return
        self._children[name].stop()
        # it may have taken the server along, and needs one to start
        self._looked = float("-inf")
        self._watch_updates()
        self._child(name, *self._commands[name])
        self._wait_ready(name)
        self._tell(f"{_first_line(error)}: started again")

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


def _first_line(error: PipelineError) -> str:
    return str(error).partition("\n")[0].removesuffix("; its last words:")
