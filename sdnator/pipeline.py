"""The whole pipeline as processes of this machine: started in order, watched, stopped in order.

Valkey (Data Updates) ─ coordinator ─┬─ switch ◄─ P4Runtime ─ p4runtime_ctrl
SQLite (Data Archives)               ├─ kitsune
                                     └─ firewall
"""

import json
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from dataplane.bmv2 import Bmv2, Bmv2Error
from dataplane.capture_port import CaptureFeed
from due.drivers.embedded_redis import EmbeddedServer
from sdnator import p4_program
from sdnator.drop_counters import DropCounters
from sdnator.errors import PipelineError
from sdnator.held_signals import held_signals
from sdnator.process import Child
from sdnator.wire import Feed, VethPair, WireFeed

SWITCH_NAME = "s1"
INGRESS_PORT = 1
EGRESS_PORT = 2


@dataclass(frozen=True, kw_only=True)
class PipelinePlan:
    """What to start."""

    folder: Path
    """Empty folder for the archive, settings and logs."""
    switch: str = "embedded"
    """embedded, bmv2, or HOST:PORT of a P4Runtime switch that runs already."""
    inject: str | None = None
    """Interface to send frames into, for a switch that runs already."""
    device_id: int = 1
    base_us: int = 0
    """What the controller adds to the switch's time stamps, in microseconds."""
    first: "Callable[[Pipeline], None] | None" = None
    """Called when Data Updates and the Coordinator run, before any app starts: data is made on demand,
    so whoever must miss nothing makes his interests known here."""
    telemetry: str = "packet-in"
    """How headers come from the switch: packet-in, or digest."""
    kitsune: Mapping[str, Any] = field(default_factory=dict)
    firewall: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _StartedSwitch:
    address: str
    inject: str | None
    base_us: int


class Pipeline:
    """A running pipeline; a context manager.

    Raises:
        PipelineError: from `start` and `check`, naming the part and its last words.
    """

    def __init__(self, plan: PipelinePlan) -> None:
        self._plan = plan
        self._logs = plan.folder / "logs"
        self._stack = ExitStack()
        self._guests = ExitStack()
        self._children: list[Child] = []
        self._bmv2: Bmv2 | None = None
        self._begun_ns = time.time_ns()
        self.updates = ""
        """URL of Data Updates."""
        self.archive = f"sqlite:///{plan.folder / 'archive.db'}"
        """URL of Data Archives."""
        # Sockets live in a folder of their own: their paths must be short, the plan's may be long.
        self._run = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="sdnator-run-")))
        self._capture_socket = str(self._run / "capture.sock")
        self._switch = _StartedSwitch("", None, self._plan.base_us)

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

    def _start(self) -> None:
        self._logs.mkdir(parents=True, exist_ok=True)
        with held_signals():
            self.updates = self._stack.enter_context(EmbeddedServer(self._run / "updates")).url
        coordinator = self._app("coordinator", "coordinator.service", {})
        self._switch = self._start_switch()
        coordinator.wait_ready()
        if self._plan.first is not None:
            self._plan.first(self)
        apps = [
            self._app("p4runtime_ctrl", "apps.p4runtime_ctrl.service", self._controller_settings()),
            self._app("kitsune", "apps.kitsune.service", self._plan.kitsune),
            self._app("firewall", "apps.firewall.service", self._plan.firewall),
        ]
        for app in apps:
            app.wait_ready()

    def _start_switch(self) -> "_StartedSwitch":
        if self._plan.switch == "embedded":
            return self._start_embedded()
        if self._plan.switch == "bmv2":
            return self._start_bmv2()
        return _StartedSwitch(self._plan.switch, self._plan.inject, time.time_ns() // 1_000)

    def _start_embedded(self) -> "_StartedSwitch":
        switch = self._child(
            "switch",
            "dataplane",
            "--grpc", "127.0.0.1:0",
            "--device-id", str(self._plan.device_id),
            "--port", f"{INGRESS_PORT}=capture:{self._capture_socket}",
            "--port", f"{EGRESS_PORT}=null",
            "--state-json", str(self._plan.folder / "switch.json"),
        )  # fmt: skip
        return _StartedSwitch(str(switch.wait_ready()["grpc"]), None, self._plan.base_us)

    def _start_bmv2(self) -> "_StartedSwitch":
        entry = VethPair.make(self._stack, "in")
        leave = VethPair.make(self._stack, "out")
        began_us = time.time_ns() // 1_000
        ports = {INGRESS_PORT: entry.far, EGRESS_PORT: leave.near}
        with held_signals():
            switch = self._stack.enter_context(Bmv2(ports, device_id=self._plan.device_id))
        self._bmv2 = switch
        return _StartedSwitch(switch.address, entry.near, began_us)

    @property
    def gives_verdicts(self) -> bool:
        """Whether the switch says of each frame what became of it."""
        return self._switch.inject is None

    def drop_counters(self) -> DropCounters:
        """What the switch's block entries count, for switches that give no verdicts."""
        return DropCounters(self._switch.address, self._plan.device_id)

    def feed(self) -> Feed:
        """Where to put frames."""
        if self._switch.inject is None:
            return CaptureFeed(self._capture_socket)
        return WireFeed(self._switch.inject)

    def _controller_settings(self) -> dict[str, Any]:
        program = p4_program.find()
        return {
            "program": str(program.bmv2_json),
            "p4info": str(program.p4info),
            "telemetry": self._plan.telemetry,
            # the archive of a folder that was used before holds an earlier run's blocks
            "restore_since": self._begun_ns,
            "switches": [
                {
                    "name": SWITCH_NAME,
                    "address": self._switch.address,
                    "device_id": self._plan.device_id,
                    "base_us": self._switch.base_us,
                    "target": self._plan.switch,
                    "forward": {str(INGRESS_PORT): EGRESS_PORT},
                }
            ],
        }

    def _app(self, name: str, module: str, settings: Mapping[str, Any]) -> Child:
        path = self._plan.folder / f"{name}.settings.json"
        path.write_text(json.dumps(settings, indent=2), encoding="utf-8")
        return self._child(
            name, module, "--updates", self.updates, "--archive", self.archive, "--settings", str(path)
        )

    def _child(self, name: str, *arguments: str) -> Child:
        with held_signals():
            child = Child(name, arguments, self._logs)
            self._children.append(child)
        return child

    def check(self) -> None:
        """Raise PipelineError if a part has died."""
        for child in self._children:
            child.check()
        if self._bmv2 is not None:
            try:
                self._bmv2.check()
            except Bmv2Error as error:
                raise PipelineError(str(error)) from None

    def before_stop(self, leave: Callable[[], None]) -> None:
        """Call `leave` before any part is stopped, also where the start fails: for users of Data Updates."""
        self._guests.callback(leave)

    def stop(self) -> None:
        """Stop all parts, the last started first."""
        try:
            self._guests.close()
        finally:
            while self._children:
                self._children.pop().stop()
            self._stack.close()

    def pids(self) -> dict[str, int]:
        """Process ids by name."""
        return {child.name: child.pid for child in self._children}


__all__ = ["EGRESS_PORT", "INGRESS_PORT", "SWITCH_NAME", "Pipeline", "PipelineError", "PipelinePlan"]
