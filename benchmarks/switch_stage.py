"""What the switch benchmarks stand on: a switch process, with or without controller and DUE, and traffic."""

import itertools
import json
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks import worker
from dataplane.ports.capture_port import CaptureFeed
from due import CONSUMER, PRODUCER, Capability, Engine, Options
from due.drivers.embedded_redis import EmbeddedServer
from sdnator import p4_program
from sdnator.supervisor import Child
from sdnator.testing.p4runtime_client import (
    EntryBuilder,
    P4RuntimeClient,
    clone_session,
    insert,
    modify,
    program_config,
)

PACKETS_KEY = "network.packets.p4runtime_ctrl.s1.all"
BLOCK_KEY = "network.block.firewall.ipv4"
CPU_PORT, COPY_SESSION = 510, 1
BURST = 256
_ids = itertools.count(1)


def frame(source: int = 1, size: int = 90) -> bytes:
    """A TCP frame from 10.x.y.z, padded to `size` bytes."""
    ip = (
        bytes.fromhex("4500004c0001000040060000")
        + (0x0A000000 + source).to_bytes(4, "big")
        + b"\x0a\xff\xff\xfe"
    )
    tcp = bytes.fromhex("1f900050000000010000000050100000") + bytes(4)
    return (bytes.fromhex("0202020202020404040404040800") + ip + tcp).ljust(size, b"\0")


def program() -> Any:
    """The compiled program and its p4info, as a ForwardingPipelineConfig."""
    return program_config(p4_program.find().bmv2_json.with_suffix(""))


class SwitchProcess:
    """The embedded switch as a process, port 1 fed by `socket`."""

    def __init__(self, folder: Path, ports: Sequence[str] = ()) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.socket = str(folder / "capture.sock")
        wanted = list(ports) or [f"1=capture:{self.socket}", "2=null"]
        self.child = Child(
            "switch", ["dataplane", *(part for port in wanted for part in ("--port", port))], folder
        )
        self.address = str(self.child.wait_ready()["grpc"])

    def close(self) -> None:
        self.child.stop()


def primary(address: str) -> P4RuntimeClient:
    """A controller with the product's program in force on the switch."""
    controller = P4RuntimeClient(address, election_id=next(_ids))
    controller.arbitrate()
    controller.set_pipeline(program())
    return controller


def every_packet(controller: P4RuntimeClient, names: EntryBuilder, *, copies: bool, digests: bool) -> None:
    """Query 0 matches everything, and wants packet-ins, digests or both."""
    controller.write(insert(clone_session(COPY_SESSION, CPU_PORT)))
    actions = {action.preamble.id: action for action in names.info.actions}
    for name, table in names.tables.items():
        if not name.startswith("ingress.telemetry_"):
            continue
        action = actions[table.action_refs[0].id]
        values = [1] * len(action.params)
        if name == "ingress.telemetry_active":
            values = [
                {"active": 1, "copies": int(copies), "digests": int(digests)}[p.name] for p in action.params
            ]
        controller.write(modify(names.default(name, action.preamble.name, values)))


def feed_process(pipe: Any, socket: str, frames: list[bytes]) -> None:
    """Feeds as many frames as it is told, again and again, until it is told 0."""
    pipe.send("ready")
    feed, sent = CaptureFeed(socket), 0
    while count := pipe.recv():
        started = time.monotonic()
        for start in range(0, count, BURST):
            burst = [frames[(sent + n) % len(frames)] for n in range(min(BURST, count - start))]
            times = list(range(sent, sent + len(burst)))
            feed.send(times, [len(one) for one in burst], burst)
            feed.verdicts()
            sent += len(burst)
        pipe.send(started)
    feed.close()


@contextmanager
def process(target: Any, *arguments: Any) -> Iterator[Any]:
    """Runs `target(pipe, …)` beside us; the pipe to it."""
    running, here = worker.start(target, *arguments)
    try:
        if not here.poll(30) or here.recv() != "ready":
            raise RuntimeError(f"{target.__name__} did not start")
        yield here
        here.send(0)
    finally:
        running.join(5)
        if running.is_alive():
            running.terminate()
            running.join()


class SwitchStage:
    """Data Updates, Coordinator, switch and controller as processes; engines here."""

    def __init__(self, folder: Path) -> None:
        logs = folder / "logs"
        logs.mkdir(parents=True)
        self._folder = folder
        self._server = EmbeddedServer(folder / "updates")
        self._server.__enter__()
        self._archive = f"sqlite://{folder / 'archive.db'}"
        self._engines: list[Engine] = []
        self.switch = SwitchProcess(folder / "switch")
        coordinator = self._app("coordinator", "coordinator.service", {})
        coordinator.wait_ready()
        compiled = p4_program.find()
        switch = {"name": "s1", "address": self.switch.address, "insecure": True, "forward": {"1": 2}}
        settings = {"switches": [switch], "program": str(compiled.bmv2_json), "p4info": str(compiled.p4info)}
        controller = self._app("p4runtime_ctrl", "apps.p4runtime_ctrl.service", settings)
        controller.wait_ready()
        self._children = [coordinator, controller]

    def _app(self, name: str, module: str, settings: dict[str, Any]) -> Child:
        path = self._folder / f"{name}.json"
        path.write_text(json.dumps(settings), encoding="utf-8")
        command = [module, "--updates", self._server.url, "--archive", self._archive, "--settings", str(path)]
        return Child(name, [*command, "--directory", str(self._folder / "due")], self._folder / "logs")

    def engine(self, app_id: str, capabilities: Sequence[Capability] = ()) -> Engine:
        """An engine of this process."""
        made = Engine(Options(directory=str(self._folder / "due"), handshake_timeout=5.0))
        made.set_pubsub(self._server.url)
        made.set_db(self._archive)
        made.init(app_id, PRODUCER | CONSUMER, capabilities=capabilities)
        self._engines.append(made)
        return made

    def close(self) -> None:
        """End everything, the last started first."""
        for made in self._engines:
            made.close()
        for child in reversed(self._children):
            child.stop()
        self.switch.close()
        self._server.__exit__(None, None, None)


class ArrivalCounter:
    """Counts what arrives, and tells when there are enough."""

    def __init__(self) -> None:
        self.total = 0
        self._wanted = 0
        self._reached = threading.Event()
        self.at = 0.0

    def expect(self, more: int) -> None:
        """From now on wait for `more`."""
        self._reached.clear()
        self._wanted = self.total + more
        if not more:
            self._reached.set()

    def add(self, rows: int) -> None:
        self.total += rows
        if self.total >= self._wanted and not self._reached.is_set():
            self.at = time.monotonic()
            self._reached.set()

    def wait(self, what: str, seconds: float = 120) -> float:
        """When the last one came.  Raises RuntimeError where they do not come."""
        if not self._reached.wait(seconds):
            raise RuntimeError(f"{what}: {self.total} of {self._wanted} arrived within {seconds:.0f} s")
        return self.at
