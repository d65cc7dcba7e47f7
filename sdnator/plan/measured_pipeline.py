"""A pipeline of `sdnator up` in a folder of its own, to be measured: embedded switches between veth pairs, and frames.

frames ──► veth ──► switch ──► veth      for each switch; /proc tells what all processes use
"""

import os
import sqlite3
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote

from sdnator.capture.interfaces import VethPair
from sdnator.errors import PipelineError
from sdnator.northbound import ask
from sdnator.plan.processes import Usage, usages
from sdnator.plan.reference_work import ReferenceWork
from sdnator.plan.steady_load import SteadyLoad
from sdnator.up import running

UPDATES = "updates"
FIRST_SWITCH = "s1"
_START_S = 300.0
_STARTED_S = 10.0
"""After the start, until what it has left to do is done: the dashboard, for one, is busy for seconds."""
_END_S = 60.0
_SCORED_S = 30.0
_SETTLE_S = 1.0
_WHOLE = 0.98
_LATE = 1.05


@dataclass(frozen=True, kw_only=True)
class LoadPhase:
    """What was used in some time."""

    elapsed_s: float
    load_s: float = 0.0
    """Of that, how long packets were sent."""
    sent: int = 0
    """Packets, at all switches together."""
    carried: bool = True
    """They were sent at the rate that was wanted, and scored."""
    cpu_s: Mapping[str, float]
    """By name of processes, of all of them together."""
    archived: int
    """Bytes that the archive has grown by."""
    updates_in: int
    updates_out: int
    reference_us: float = 0.0
    """CPU that the reference work took meanwhile; 0: not measured."""

    def at(self, reference_us: float) -> "LoadPhase":
        """The same on a machine as fast as it was when the reference work took this long."""
        if not (self.reference_us and reference_us):
            return self
        speed = reference_us / self.reference_us
        return replace(
            self,
            cpu_s={name: each * speed for name, each in self.cpu_s.items()},
            reference_us=reference_us,
        )


@dataclass(frozen=True)
class _Moment:
    at: float
    used: Mapping[str, Usage]
    archive: int


class MeasuredPipeline:
    """Runs `sdnator up`; a context manager.  Linux, root.

    Args:
        folder: for state, data and configuration.
        switches: up to 13: an interface's name has a letter for each pair of interfaces.
        train: packets on which Kitsune trains.
        ports: whether the switches have interfaces; without them nothing can be sent.

    Raises:
        BadInput: no permission to make interfaces.
        PipelineError: it does not start, or stops.
    """

    def __init__(self, folder: Path, switches: int, train: int, *, ports: bool = True) -> None:
        self.folder = folder
        self.switches = switches
        self._train = train
        self._ports = ports
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        try:
            self._start()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def _start(self) -> None:
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        pairs = [
            tuple(VethPair.make(self._stack, f"p{chr(ord('a') + 2 * number + side)}") for side in (0, 1))
            for number in range(self.switches if self._ports else 0)
        ]
        places = [f'"1=veth:{near.far}", "2=veth:{far.near}"' for near, far in pairs]
        text = configuration(places or ['"1=null", "2=null"'] * self.switches)
        (self.folder / "sdnator.toml").write_text(text, encoding="utf-8")
        self._load = SteadyLoad([near.near for near, _ in pairs])
        self._stack.callback(self._load.close)
        self._up()
        self.running = self._wait()
        self._names = {pid: _kind(name) for name, pid in self.running.parts.items()}
        time.sleep(_STARTED_S)

    def _up(self) -> None:
        places = {f"XDG_{name}_HOME": str(self.folder / name.lower()) for name in ("STATE", "DATA", "CONFIG")}
        command = [sys.executable, "-m", "sdnator.cli.main", "up", "--json", "--no-mitigate"]
        command += ["--config", str(self.folder / "sdnator.toml"), "--train", str(self._train)]
        with (self.folder / "up.log").open("wb") as log:
            self._process = subprocess.Popen(
                command,
                env={**os.environ, **places},
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                # Ctrl-C is for this program, which ends it in order
                start_new_session=True,
            )
        self._stack.callback(self._end)

    def _end(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _wait(self) -> running.Running:
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline and self._process.poll() is None:
            found = running.find(self.folder / "state" / "sdnator")
            if found is not None and found.coordinator:
                return found
            time.sleep(0.1)
        raise PipelineError(f"the pipeline to be measured does not run: {self._said()}")

    def _said(self) -> str:
        return (self.folder / "up.log").read_text(encoding="utf-8", errors="replace")[-2000:].strip()

    def idle(self, seconds: float) -> LoadPhase:
        """What is used without packets."""
        before = self._moment()
        with ReferenceWork() as reference:
            time.sleep(seconds)
        return self._phase(before, reference_us=reference.us)

    def loaded(self, pps: float, seconds: float) -> LoadPhase:
        """What is used for so many packets a second at each switch, until they are scored."""
        before, sent, scored = self._moment(), self._load.sent, self._scored()
        with ReferenceWork() as reference:
            took = self._load.send(pps, seconds)
        sent = self._load.sent - sent
        deadline = time.monotonic() + _SCORED_S
        while (missing := scored + _WHOLE * sent - self._scored()) > 0 and time.monotonic() < deadline:
            time.sleep(_SETTLE_S / 4)
        time.sleep(_SETTLE_S)
        carried = missing <= 0 and took <= _LATE * seconds
        return self._phase(before, load_s=took, sent=sent, carried=carried, reference_us=reference.us)

    def mib(self) -> dict[str, float]:
        """Memory by name of processes, of all of them together."""
        found = usages(self._process.pid, self._names, memory=True)
        return {name: each.kib / 1024 for name, each in found.items()}

    def health(self) -> Mapping[str, Any]:
        """Of the apps, from the Coordinator."""
        apps: Mapping[str, Any] = ask(self.running.coordinator, "/health").get("apps", {})
        return apps

    def _scored(self) -> int:
        told = self.health().get("kitsune", {}).get("health", {}).get("app", {})
        return int(told.get("packets", 0))

    def _moment(self) -> _Moment:
        if self._process.poll() is not None:
            raise PipelineError(f"the pipeline to be measured has ended: {self._said()}")
        return _Moment(
            time.monotonic(),
            usages(self._process.pid, self._names),
            archive_bytes(self.folder / "data" / "sdnator" / "archive.db"),
        )

    def _phase(self, before: _Moment, **more: Any) -> LoadPhase:
        after = self._moment()
        none = Usage()
        cpu = {name: each.cpu_s - before.used.get(name, none).cpu_s for name, each in after.used.items()}
        server, earlier = after.used.get(UPDATES, none), before.used.get(UPDATES, none)
        return LoadPhase(
            elapsed_s=after.at - before.at,
            cpu_s={name: max(0.0, each) for name, each in cpu.items()},
            archived=after.archive - before.archive,
            updates_in=server.read - earlier.read,
            updates_out=server.written - earlier.written,
            **more,
        )


def configuration(ports: Sequence[str]) -> str:
    """`sdnator.toml` for switches with these ports, as text of TOML arrays."""
    switches = (
        f'[[switches]]\nname = "s{number}"\ndevice_id = {number}\nports = [{each}]\n'
        for number, each in enumerate(ports, start=1)
    )
    return "\n".join(("[dashboard]\nport = 0\n", *switches))


def archive_bytes(file: Path) -> int:
    """What a SQLite file takes, with what is still in its log; the size of the file itself grows in jumps."""
    if not file.exists():
        return 0
    with closing(sqlite3.connect(f"file:{quote(str(file))}?mode=ro", uri=True)) as connection:
        pages, size, free = (
            connection.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("page_count", "page_size", "freelist_count")
        )
    return int((pages - free) * size)


def _kind(part: str) -> str:
    return "switch" if part.startswith("switch-") else part
