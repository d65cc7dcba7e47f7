"""The controller among real processes: Data Updates, Coordinator, a switch, and the test's own engines.

with ControllerRun(folder) as stage:
    stage.controller()
    heard = Heard(stage.engine("listener"), PACKETS)
    feed = stage.feed()
    feed.send([0], [60], [frame(1)])
    wait_for(lambda: len(heard.arrivals()))
"""

import json
import threading
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from apps.messages import Decision
from apps.messages import Target as Sender
from apps.p4runtime_ctrl.southbound.connection import Connection
from apps.p4runtime_ctrl.southbound.session import Address, CompiledProgram
from dataplane.ports.capture_port import CaptureFeed
from due import Engine, Item, Options
from due.drivers.embedded_redis import EmbeddedServer
from p4rt import INSECURE
from sdnator.supervisor import Child
from sdnator.testing.product_program import P4INFO, PROGRAM, program
from sdnator.testing.switch_target import SwitchTarget
from sdnator.testing.waiting import wait_for

BASE_US = 1_540_446_400_000_000
"""Absolute time of the switch's clock zero, µs."""
PACKETS = "network.packets.p4runtime_ctrl.s1.all"
"""Key of the packets of the switch, which is called s1."""
_END_S = 60.0


class ControllerRun:
    """Data Updates, Coordinator and switch, running between enter and exit; apps as `run` starts them.

    Args:
        folder: for logs, sockets and the archive.
        kind: of the switch: embedded or bmv2.
        veth: interface of port 1; empty: a capture port, which `feed` feeds.  Port 2 leads nowhere.
        switch_options: of the controller's settings of the switch, instead of the usual ones.

    Parts that die are not restarted: tests of faults look at that.
    """

    def __init__(
        self, folder: Path, *, kind: str = "embedded", veth: str = "", **switch_options: object
    ) -> None:
        self.folder = folder
        self.archive = f"sqlite://{folder / 'archive.db'}"
        """URL of the Data Archives."""
        self._sockets = folder / "in.sock"
        entry = f"veth:{veth}" if veth else f"capture:{self._sockets}"
        self.target = SwitchTarget(kind, folder, ports=(f"1={entry}", "2=null"))
        self.switch_options = switch_options
        self.processes: list[Child] = []
        """Coordinator and apps, in the order of their starts."""
        self._engines: list[Engine] = []
        self.server = EmbeddedServer(folder / "updates")
        """The Data Updates server; `server.url` is its URL."""

    def __enter__(self) -> Self:
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
            process.stop()
        self.target.stop()
        self.server.__exit__(None, None, None)

    def run(
        self,
        module: str,
        settings: dict[str, object] | None = None,
        engine: dict[str, object] | None = None,
    ) -> Child:
        """Start a service and return when it is ready; its log is MODULE.log in the folder.

        Args:
            module: behind `python -m`.
            settings: of the service; None: its defaults.
            engine: options of its engine, as of `due.Options`; None: the defaults.

        Returns:
            Its process, which the run ends.

        Raises:
            PipelineError: it ended instead; the text has its last words.
        """
        command = [module, "--updates", self.server.url, "--archive", self.archive]
        command += ["--directory", str(self.folder / "due")]
        for name, content in (("settings", settings), ("engine", engine)):
            if content is not None:
                path = self.folder / f"{name}{len(self.processes)}.json"
                path.write_text(json.dumps(content), encoding="utf-8")
                command += [f"--{name}", str(path)]
        process = Child(module, command, self.folder)
        self.processes.append(process)
        process.wait_ready()
        return process

    def controller(self, **options: object) -> Child:
        """Start the controller and return when it is ready.

        Args:
            options: of its settings; `switches` instead of the one switch of this run.

        Returns:
            Its process, which the run ends.
        """
        switch = {
            "name": "s1",
            "address": self.target.address,
            "insecure": True,
            "base_us": BASE_US,
            "forward": {"1": 2},
            **self.switch_options,
        }
        switches = options.pop("switches", [switch])
        settings = {"switches": switches, "program": str(PROGRAM), "p4info": str(P4INFO), **options}
        return self.run("apps.p4runtime_ctrl.service", settings)

    def kill(self, process: Child) -> None:
        """End a process as `kill -9` does.

        Args:
            process: one that `run` or `controller` has started.
        """
        process.kill()
        process.close()

    def engine(self, app_id: str = "firewall", **init: Any) -> Engine:
        """Open an engine in this process; the run closes it.

        Args:
            app_id: whose keys it may write.
            init: further arguments of `Engine.init`.

        Returns:
            The engine, connected.
        """
        engine = Engine(Options(directory=str(self.folder / "due"), handshake_timeout=5.0))
        engine.set_pubsub(self.server.url)
        engine.set_db(self.archive)
        engine.init(app_id, **init)
        self._engines.append(engine)
        return engine

    def feed(self) -> CaptureFeed:
        """Connect to the capture port 1.

        Returns:
            What feeds it; the caller closes it.
        """
        return CaptureFeed(str(self._sockets))

    def log(self) -> str:
        """Read the controller's log.

        Returns:
            All that it has logged so far.
        """
        return (self.folder / "apps.p4runtime_ctrl.service.log").read_text(encoding="utf-8")


def end(process: Child) -> str:
    """Ask a process to end and wait for that.

    Returns:
        How it ended, such as "… ended with exit code 0".

    Raises:
        TookTooLong: it still runs after a minute.
    """
    process.ask_to_end()
    wait_for(process.ended, _END_S, lambda: f"{process.name} still runs")
    how = process.ended() or ""
    process.close()
    return how


def frame(source: int) -> bytes:
    """A UDP frame of 60 bytes from 10.0.0.<source> to 10.0.0.250; `source` of 0 to 255."""
    ethernet = bytes.fromhex("0200000000ff02000000") + source.to_bytes(2, "big") + b"\x08\x00"
    ip = bytes.fromhex("4500002e0001000040110000") + bytes([10, 0, 0, source, 10, 0, 0, 250])
    return ethernet + ip + bytes.fromhex("03e80035001a0000") + b"x" * 18


def block(number: int, source: int, action: str = "block") -> Decision:
    """A decision, without an end, about the sender of `frame(source)`.

    Args:
        number: makes the decision's id.
        source: last byte of the address.
        action: of `apps.messages.Decision`.
    """
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
    """A primary that does nothing: the embedded switch holds a capture's frames while it has none.

    Args:
        address: of the switch.
        rank: that decides who is primary.
    """

    def __init__(self, address: str, *, rank: int = 1) -> None:
        compiled = CompiledProgram(PROGRAM.read_bytes(), program().message)
        self._primary = threading.Event()
        self._connection = Connection(Address(address, 1, rank, security=INSECURE), compiled, self)

    def __enter__(self) -> Self:
        self._connection.open()
        wait_for(self._primary.is_set, why=lambda: "another controller is primary")
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def became_primary(self, _session: object) -> None:
        """It is primary.

        Args:
            _session: of the connection.
        """
        self._primary.set()

    def became_backup(self) -> None:
        """Nothing follows from it."""

    def lost(self, cause: str) -> None:
        """Nothing follows from it.

        Args:
            cause: why the connection ended.
        """

    def packets(self, messages: object) -> None:
        """Drop packet-ins.

        Args:
            messages: PacketIn messages.
        """

    def digests(self, lists: object) -> None:
        """Drop digests.

        Args:
            lists: serialized DigestLists.
        """

    def other(self, message: object) -> None:
        """Drop any other message.

        Args:
            message: a StreamMessageResponse.
        """


class Heard:
    """What an engine hears of some keys.

    Args:
        engine: that observes.
        keys: with wildcards, if wanted.
    """

    def __init__(self, engine: Engine, *keys: str) -> None:
        self.items: list[Item] = []
        """All items so far, in order."""
        self.subscriptions = [engine.observe(key).subscribe(self.items.append) for key in keys]

    def arrivals(self) -> NDArray[np.uint64]:
        """Which packets it has heard of.

        Returns:
            Arrival numbers of all packets so far, in the order of their items, shape (n,).
        """
        batches = [item.value["arrival"] for item in self.items if item.key == PACKETS]
        return np.concatenate(batches) if batches else np.zeros(0, dtype=np.uint64)

    def values(self, part: str) -> list[dict[str, Any]]:
        """Values of some of the items.

        Args:
            part: text that their keys contain.

        Returns:
            The values, in the order of the items.
        """
        return [item.value for item in self.items if part in item.key]

    def stop(self) -> None:
        """Hear no more."""
        for subscription in self.subscriptions:
            subscription.dispose()
