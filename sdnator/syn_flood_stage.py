"""The processes of the SYN flood demo: the product around the lab's switch, and the lab's hosts.

Valkey, coordinator, Sonata adapter and firewall live where the demo was started and speak through a Unix
socket; switch and controller live in the switch's namespace.
"""

import json
import os
import tempfile
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from apps.messages import Confirmation, Decision, TableCommand, TableUpdate
from dataplane.bmv2 import Bmv2, Bmv2Error
from due import CONSUMER, NO_WAIT, PRODUCER, Capability, Engine, Interest, Item
from due.drivers.embedded_redis import EmbeddedServer
from sdnator import p4_program
from sdnator.errors import BadInput, PipelineError
from sdnator.held_signals import held_signals
from sdnator.process import Child
from sdnator.syn_flood_lab import HOSTS, Lab, mac

SWITCH: Final = "s1"
PARTS: Final = ("switch", "coordinator", "p4runtime_ctrl", "sonata_adapter", "firewall")
_DEVICE: Final = 1
_COMMAND: Final = f"network.p4_command.demo.{SWITCH}"
_SECONDS: Final = 30.0
_AGAIN_S: Final = 0.5
_IDLE_LOOK_S, _IDLE_SHARE = 0.3, 0.25
_HEARD: Final = (
    "network.confirmation.p4runtime_ctrl.*",
    "network.block.firewall.*",
    "network.protect.firewall.*",
)
_HEALTH: Final = "due.health.firewall"


class Stage:
    """Everything that runs; a context manager.  Raises `PipelineError` naming the part that failed."""

    def __init__(self, lab: Lab, folder: Path, *, switch: str, guard: Mapping[str, Any]) -> None:
        self.lab = lab
        self.folder = folder
        self._kind = switch
        self._guard = dict(guard)
        self._stack = ExitStack()
        self._children: list[Child] = []
        self._made = 0
        self.confirmed: list[tuple[float, Confirmation]] = []
        """Wall time and confirmation."""
        self.decisions: list[Decision] = []
        self.firewall: dict[str, Any] = {}
        """The firewall's latest health."""
        self.grpc = ""

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

    def stop(self) -> None:
        """Stop all parts, the last started first."""
        while self._children:
            self._children.pop().stop()
        self._stack.close()

    def _start(self) -> None:
        (self.folder / "logs").mkdir(parents=True, exist_ok=True)
        archive = self.folder / "archive.db"
        if archive.exists():
            raise BadInput(f"{self.folder} holds another run: name a folder that is new or empty")
        self._run = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="sdnator-syn-")))
        with held_signals():
            self._updates = self._stack.enter_context(EmbeddedServer(self._run)).url
        self._archive = f"sqlite:///{archive}"
        coordinator = self.app("coordinator", "coordinator.service", {})
        with self.lab.inside("switch"):
            base_us = self._start_switch()
            coordinator.wait_ready()
            self.app("p4runtime_ctrl", "apps.p4runtime_ctrl.service", self._controller(base_us)).wait_ready()
        self._engine = self._connect()
        self._forward()

    def _start_switch(self) -> int:
        """Its address is noted; returns the absolute time of its clock's zero, µs."""
        ports = {number: f"p{number}" for number in range(1, len(HOSTS) + 1)}
        if self._kind == "bmv2":
            began_us = time.time_ns() // 1000
            try:
                with held_signals():
                    self.grpc = self._stack.enter_context(Bmv2(ports, device_id=_DEVICE)).address
            except Bmv2Error as error:
                raise PipelineError(str(error)) from None
            return began_us
        options = [option for number, name in ports.items() for option in ("--port", f"{number}=veth:{name}")]
        state = ("--state-json", str(self.folder / "switch.json"))
        self.grpc = str(self._child("switch", "dataplane", *options, *state).wait_ready()["grpc"])
        return time.time_ns() // 1000

    def _controller(self, base_us: int) -> dict[str, Any]:
        program = p4_program.find()
        switch = {
            "name": SWITCH,
            "address": self.grpc,
            "device_id": _DEVICE,
            "base_us": base_us,
            "target": self._kind,
        }
        return {
            "program": str(program.bmv2_json),
            "p4info": str(program.p4info),
            "switches": [switch],
            "guard": self._guard,
        }

    def _connect(self) -> Engine:
        engine = Engine()
        engine.set_pubsub(self._updates)
        engine.set_db(self._archive)
        commands = Capability(_COMMAND, delivery="reliable")
        interests = [Interest(key) for key in _HEARD]
        engine.init("demo", PRODUCER | CONSUMER, interests=interests, capabilities=[commands])
        self._stack.callback(engine.close)
        for key in _HEARD:
            engine.observe(key).subscribe(self._on_item)
        engine.observe(_HEALTH).subscribe(self._on_health)
        return engine

    def _on_item(self, item: Item) -> None:
        if item.key.startswith("network.confirmation"):
            self.confirmed.append((item.timestamp / 1e9, Confirmation.from_value(item.value)))
        else:
            self.decisions.append(Decision.from_value(item.value))

    def _on_health(self, item: Item) -> None:
        self.firewall = item.value["app"]

    def _forward(self) -> None:
        """Static L2 entries: nobody has to learn or flood."""
        updates = tuple(
            TableUpdate(
                kind="insert",
                table="ingress.dmac",
                match={"vid": 0, "eth_dst": mac(host)},
                action="set_egress",
                params={"port": port},
            )
            for port, host in enumerate(HOSTS, start=1)
        )
        deadline, again = time.monotonic() + _SECONDS, 0.0
        while not any(said.state in ("installed", "exists") for _, said in self.confirmed):
            if time.monotonic() > deadline:
                said = self.confirmed[-1][1].cause if self.confirmed else "nothing"
                raise PipelineError(f"switch {SWITCH} did not take its forwarding entries; it said: {said}")
            if time.monotonic() > again:
                command = TableCommand(id=f"forward-{time.monotonic_ns()}", updates=updates)
                self._engine.write(_COMMAND, command.to_value(), [NO_WAIT])
                again = time.monotonic() + _AGAIN_S
            self.wait(0.05)

    def app(self, name: str, module: str, settings: Mapping[str, Any]) -> Child:
        """Start an app of the product."""
        path = self._write(name, settings)
        return self._child(
            name, module, "--updates", self._updates, "--archive", self._archive, "--settings", path
        )

    def host(self, host: str, role: str, options: Mapping[str, Any]) -> "Host":
        """Start a role of `syn_flood_hosts` in a host's namespace."""
        report, orders = self._path(role, "jsonl"), self._run / f"{host}-{role}.orders"
        os.mkfifo(orders)
        told = {**options, "report": str(report), "orders": str(orders)}
        with self.lab.inside(host):
            child = self._child(f"{host}-{role}", "sdnator.syn_flood_hosts", role, self._write(role, told))
        child.wait_ready()
        return Host(child, report, orders)

    def settle(self, seconds: float) -> bool:
        """Wait until no part is busy with what came before; False where one still is after so long."""
        deadline = time.monotonic() + seconds
        parts = [child.pid for child in self._children if child.name in PARTS]
        before = [_used(pid) for pid in parts]
        while time.monotonic() < deadline:
            self.wait(_IDLE_LOOK_S)
            now = [_used(pid) for pid in parts]
            if all(
                after - earlier <= _IDLE_SHARE * _IDLE_LOOK_S
                for earlier, after in zip(before, now, strict=True)
            ):
                return True
            before = now
        return False

    def memory(self) -> dict[str, float]:
        """Resident memory of each part of the product, MB."""
        parts = [child for child in self._children if child.name in PARTS]
        return {child.name: _resident(child.pid) for child in parts}

    def _write(self, name: str, settings: Mapping[str, Any]) -> str:
        path = self._path(name, "settings.json")
        path.write_text(json.dumps(settings, indent=2), encoding="utf-8")
        return str(path)

    def _path(self, name: str, kind: str) -> Path:
        self._made += 1
        return self.folder / f"{name}-{self._made}.{kind}"

    def _child(self, name: str, *arguments: str) -> Child:
        with held_signals():
            child = Child(name, arguments, self.folder / "logs")
            self._children.append(child)
        return child

    def wait(self, seconds: float) -> None:
        """Wait, and raise if a part has died meanwhile."""
        time.sleep(seconds)
        for child in self._children:
            child.check()


@dataclass(frozen=True)
class Host:
    """A role at work in a host's namespace."""

    child: Child
    report: Path
    """JSON lines."""
    _orders: Path

    def order(self, order: Mapping[str, Any]) -> None:
        """Tell it what to do; raises `PipelineError` where it has ended."""
        line = json.dumps(order).encode() + b"\n"
        try:
            descriptor = os.open(self._orders, os.O_WRONLY | os.O_NONBLOCK)
        except OSError as error:
            self.child.check()
            raise PipelineError(f"{self.child.name} takes no orders: {error.strerror}") from error
        try:
            os.write(descriptor, line)
        finally:
            os.close(descriptor)


def _used(pid: int) -> float:
    """Processor time of a process, s."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _resident(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return round(pages * os.sysconf("SC_PAGESIZE") / 1e6, 1)
