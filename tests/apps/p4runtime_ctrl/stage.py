"""The controller among real processes: Data Updates, Coordinator, switch, and an app that listens."""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from apps.messages import Decision
from apps.messages import Target as Sender
from apps.p4runtime_ctrl.connection import Connection
from apps.p4runtime_ctrl.session import Address, Pipeline
from dataplane.capture_port import CaptureFeed
from due import Engine, Item, Options
from due.drivers.embedded_redis import EmbeddedServer
from tests.apps.p4runtime_ctrl.programs import P4INFO, PROGRAM, program
from tests.apps.p4runtime_ctrl.targets import Target

BASE_US = 1_540_446_400_000_000
PACKETS = "network.packets.p4runtime_ctrl.s1.all"


class Stage:
    """`with Stage(folder) as stage:`; what it starts ends with it."""

    def __init__(
        self, folder: Path, *, kind: str = "embedded", veth: str = "", **switch_options: object
    ) -> None:
        self.folder = folder
        self.archive = f"sqlite://{folder / 'archive.db'}"
        self._sockets = folder / "in.sock"
        entry = f"veth:{veth}" if veth else f"capture:{self._sockets}"
        self.target = Target(kind, folder, ports=(f"1={entry}", "2=null"))
        self.switch_options = switch_options
        self.processes: list[subprocess.Popen[str]] = []
        self._engines: list[Engine] = []
        self.server = EmbeddedServer(folder / "updates")
        self.items: list[Item] = []

    def __enter__(self) -> "Stage":
        try:
            self.server.__enter__()
            self.target.start()
            self.run("coordinator.service")
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all that was started, also where the start failed half-way."""
        for engine in self._engines:
            engine.close()
        for process in reversed(self.processes):
            end(process)
        self.target.stop()
        self.server.__exit__(None, None, None)

    def run(self, module: str, settings: dict[str, object] | None = None) -> subprocess.Popen[str]:
        """Start a service and wait for its ready line."""
        command = [sys.executable, "-m", module, "--updates", self.server.url, "--archive", self.archive]
        command += ["--directory", str(self.folder / "due")]
        if settings is not None:
            path = self.folder / f"settings{len(self.processes)}.json"
            path.write_text(json.dumps(settings))
            command += ["--settings", str(path)]
        log = (self.folder / f"{module}.log").open("a")
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, env=environment)
        log.close()
        self.processes.append(process)
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line, (self.folder / f"{module}.log").read_text()[-4000:]
        assert json.loads(line)["ready"]
        return process

    def controller(self, **options: object) -> subprocess.Popen[str]:
        switch = {
            "name": "s1",
            "address": self.target.address,
            "base_us": BASE_US,
            "forward": {"1": 2},
            **self.switch_options,
        }
        switches = options.pop("switches", [switch])
        settings = {"switches": switches, "program": str(PROGRAM), "p4info": str(P4INFO), **options}
        return self.run("apps.p4runtime_ctrl.service", settings)

    def kill(self, process: subprocess.Popen[str]) -> None:
        process.kill()
        process.wait(60)

    def engine(self, app_id: str = "firewall", **init: object) -> Engine:
        engine = Engine(Options(directory=str(self.folder / "due"), handshake_timeout=5.0))
        engine.set_pubsub(self.server.url)
        engine.set_db(self.archive)
        engine.init(app_id, **init)  # type: ignore[arg-type]
        self._engines.append(engine)
        return engine

    def feed(self) -> CaptureFeed:
        return CaptureFeed(str(self._sockets))

    def log(self) -> str:
        return (self.folder / "apps.p4runtime_ctrl.service.log").read_text()


def end(process: subprocess.Popen[str]) -> int:
    if process.poll() is None:
        process.terminate()
    code = process.wait(60)
    if process.stdout is not None:
        process.stdout.close()
    return code


def wait_for(condition: Callable[[], object], seconds: float = 90.0, why: Callable[[], object] = str) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, why()
        time.sleep(0.01)


def frame(source: int) -> bytes:
    """A UDP frame from 10.0.0.<source>."""
    ethernet = bytes.fromhex("0200000000ff02000000") + source.to_bytes(2, "big") + b"\x08\x00"
    ip = bytes.fromhex("4500002e000100004011 0000".replace(" ", "")) + bytes(
        [10, 0, 0, source, 10, 0, 0, 250]
    )
    return ethernet + ip + bytes.fromhex("03e80035001a0000") + b"x" * 18


def block(number: int, source: int, action: str = "block") -> Decision:
    return Decision(
        id=f"d{number}",
        action=action,  # type: ignore[arg-type]
        switch="s1",
        target=Sender(kind="ip", address=f"10.0.0.{source}"),
        reason="a test",
        event_time=1,
        expires=0,
    )


class Bystander:
    """A primary that does nothing: the embedded switch holds a capture's frames while it has none."""

    def __init__(self, address: str, *, rank: int = 1) -> None:
        pipeline = Pipeline(PROGRAM.read_bytes(), program().message)
        self._primary = threading.Event()
        self._connection = Connection(Address(address, 1, rank), pipeline, self)

    def __enter__(self) -> "Bystander":
        self._connection.open()
        assert self._primary.wait(60)
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def became_primary(self, _session: object) -> None:
        self._primary.set()

    def became_backup(self) -> None: ...
    def lost(self, cause: str) -> None: ...
    def packets(self, messages: object) -> None: ...
    def digests(self, lists: object) -> None: ...
    def other(self, message: object) -> None: ...


class Heard:
    """What an engine hears of some keys."""

    def __init__(self, engine: Engine, *keys: str) -> None:
        self.items: list[Item] = []
        self.subscriptions = [engine.observe(key).subscribe(self.items.append) for key in keys]

    def arrivals(self) -> np.ndarray:
        batches = [item.value["arrival"] for item in self.items if item.key == PACKETS]
        return np.concatenate(batches) if batches else np.zeros(0, dtype=np.uint64)

    def values(self, part: str) -> list[dict[str, object]]:
        return [item.value for item in self.items if part in item.key]

    def stop(self) -> None:
        for subscription in self.subscriptions:
            subscription.dispose()
