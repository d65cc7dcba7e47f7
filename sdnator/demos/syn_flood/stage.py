"""The processes of the SYN flood demo: the product around the lab's switch, and the lab's hosts.

Valkey, coordinator, Sonata adapter and firewall live where the demo was started and speak through a Unix
socket; switch and controller live in the switch's namespace.
"""

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from apps.messages import Confirmation, Decision, TableCommand, TableUpdate
from due import CONSUMER, NO_WAIT, PRODUCER, Capability, Engine, Interest, Item
from due.drivers.embedded_redis import EmbeddedServer
from sdnator import p4_program
from sdnator.demos.syn_flood.lab import HOSTS, Lab, mac
from sdnator.errors import BadInput, PipelineError
from sdnator.supervisor import Child, PartSpec, Supervisor
from sdnator.supervisor.app_command import Backends, app_command
from sdnator.supervisor.spec import PartProcess
from sdnator.supervisor.switch_program import SwitchProgram
from sdnator.supervisor.updates_server import UpdatesProcess
from sdnator.supervisor.whole_or_none import WholeOrNone

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


class FloodStage(WholeOrNone):
    """Everything that runs; a context manager.  Raises `PipelineError` naming the part that failed."""

    def __init__(self, lab: Lab, folder: Path, *, switch: str, guard: Mapping[str, Any]) -> None:
        self.lab = lab
        self.folder = folder
        self._kind = switch
        self._guard = dict(guard)
        self._stack = ExitStack()
        self._supervisor = Supervisor((), _tell)
        self._switch: SwitchProgram | None = None
        self._made = 0
        self.confirmed: list[tuple[float, Confirmation]] = []
        """Wall time and confirmation."""
        self.decisions: list[Decision] = []
        self.firewall: dict[str, Any] = {}
        """The firewall's latest health."""

    def stop(self) -> None:
        """Stop all parts, the last started first."""
        try:
            self._supervisor.stop()
        finally:
            self._stack.close()

    @property
    def grpc(self) -> str:
        """Where the switch serves P4Runtime."""
        return self._switch.address if self._switch is not None else ""

    def _start(self) -> None:
        (self.folder / "logs").mkdir(parents=True, exist_ok=True)
        archive = self.folder.absolute() / "archive.db"
        if archive.exists():
            raise BadInput(f"{self.folder} holds another run: name a folder that is new or empty")
        self._run = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="sdnator-syn-")))
        server = EmbeddedServer(self._run)
        self._stack.callback(server.stop)
        self._updates, self._archive = server.url, f"sqlite:///{archive}"
        self._add("updates", partial(UpdatesProcess, server))
        self._add("coordinator", partial(self._app, "coordinator", {}), after=("updates",))
        self._switch = self._switch_program()
        self._add("switch", self._switch.start, inside=self._in_switch)
        self._supervisor.start()
        self._add(
            "p4runtime_ctrl", partial(self._app, "p4runtime_ctrl", self._controller()), inside=self._in_switch
        )
        self._supervisor.start()
        self._engine = self._connect()
        self._forward()

    def _in_switch(self) -> AbstractContextManager[None]:
        return self.lab.inside("switch")

    def _switch_program(self) -> SwitchProgram:
        ports = {number: f"p{number}" for number in range(1, len(HOSTS) + 1)}
        if self._kind == "bmv2":
            return SwitchProgram("bmv2", name="switch", logs=self._logs, ports=ports, device_id=_DEVICE)
        return SwitchProgram(
            "embedded",
            name="switch",
            logs=self._logs,
            ports={number: f"veth:{name}" for number, name in ports.items()},
            address=f"unix:{self._run / 'switch.sock'}",
            device_id=_DEVICE,
            options=("--state-json", str(self.folder / "switch.json")),
        )

    @property
    def _logs(self) -> Path:
        return self.folder / "logs"

    def _controller(self) -> dict[str, Any]:
        program = p4_program.find()
        switch = {
            "name": SWITCH,
            "address": self.grpc,
            "device_id": _DEVICE,
            "insecure": self._kind == "bmv2",
            "base_us": self._switch.base_us if self._switch is not None else 0,
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
                raise PipelineError(f"switch {SWITCH} did not accept its forwarding entries; it said: {said}")
            if time.monotonic() > again:
                command = TableCommand(id=f"forward-{time.monotonic_ns()}", updates=updates)
                self._engine.write(_COMMAND, command.to_value(), [NO_WAIT])
                again = time.monotonic() + _AGAIN_S
            self.wait(0.05)

    def start_apps(self, settings: Mapping[str, Mapping[str, Any]]) -> None:
        """Start apps of the product, and return when all are ready."""
        for name, own in settings.items():
            self._add(name, partial(self._app, name, own))
        self._supervisor.start()

    def host(self, host: str, role: str, options: Mapping[str, Any]) -> "LabHost":
        """Start a role of `syn_flood_hosts` in a host's namespace."""
        report, orders = self._path(role, "jsonl"), self._run / f"{host}-{role}.orders"
        os.mkfifo(orders)
        told = {**options, "report": str(report), "orders": str(orders)}
        name, command = f"{host}-{role}", ("sdnator.demos.syn_flood.hosts", role, self._write(role, told))
        self._add(name, partial(Child, name, command, self._logs), inside=partial(self.lab.inside, host))
        self._supervisor.start()
        return LabHost(self, name, report, orders)

    def settle(self, seconds: float) -> bool:
        """Wait until no part is busy with what came before; False where one still is after so long."""
        deadline = time.monotonic() + seconds
        parts = list(self._product().values())
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
        return {name: _resident(pid) for name, pid in self._product().items()}

    def cpu_seconds(self) -> dict[str, float]:
        """Processor time of each part of the product since its start, s."""
        return {name: _used(pid) for name, pid in self._product().items()}

    def _product(self) -> dict[str, int]:
        """Process ids of the product's own parts; BMv2 is none."""
        ours = [name for name in PARTS if name != "switch" or self._kind == "embedded"]
        return {name: pid for name, pid in self._supervisor.pids().items() if name in ours}

    def _write(self, name: str, settings: Mapping[str, Any]) -> str:
        path = self._path(name, "settings.json")
        path.write_text(json.dumps(settings, indent=2), encoding="utf-8")
        return str(path)

    def _path(self, name: str, kind: str) -> Path:
        self._made += 1
        return self.folder / f"{name}-{self._made}.{kind}"

    def _add(
        self,
        name: str,
        start: Callable[[], PartProcess],
        *,
        after: tuple[str, ...] = (),
        inside: Callable[[], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        self._supervisor.add(PartSpec(name=name, start=start, after=after, inside=inside, restart=None))

    def _app(self, name: str, settings: Mapping[str, Any]) -> Child:
        backends = Backends(updates=self._updates, archive=self._archive)
        return Child(name, app_command(name, self.folder, backends, settings), self._logs)

    def wait(self, seconds: float) -> None:
        """Wait, and raise if a part has died meanwhile."""
        time.sleep(seconds)
        self.check()

    def check(self) -> None:
        """Raise PipelineError if a part has died."""
        self._supervisor.watch()


@dataclass(frozen=True)
class LabHost:
    """A role at work in a host's namespace."""

    stage: FloodStage
    name: str
    report: Path
    """JSON lines."""
    _orders: Path

    def order(self, order: Mapping[str, Any]) -> None:
        """Tell it what to do; raises `PipelineError` where it has ended."""
        line = json.dumps(order).encode() + b"\n"
        try:
            descriptor = os.open(self._orders, os.O_WRONLY | os.O_NONBLOCK)
        except OSError as error:
            self.stage.check()
            raise PipelineError(f"{self.name} accepts no commands: {error.strerror}") from error
        try:
            os.write(descriptor, line)
        finally:
            os.close(descriptor)


def _tell(text: str) -> None:
    print(f"sdnator: {text}", file=sys.stderr, flush=True)


def _used(pid: int) -> float:
    """Processor time of a process, s."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _resident(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return round(pages * os.sysconf("SC_PAGESIZE") / 1e6, 1)
