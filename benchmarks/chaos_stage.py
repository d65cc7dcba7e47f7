"""The pipeline of `sdnator up` as the faults find it: own disk, own wires, a relay before each app, settable clocks."""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from benchmarks.chaos_links import UnixLink
from benchmarks.chaos_probes import ARCHIVED
from benchmarks.chaos_schedule import APPS, CONTROLLERS
from sdnator.capture.interfaces import VethPair
from sdnator.config.planned_switches import PlannedSwitch
from sdnator.supervisor import Child, Supervisor
from sdnator.supervisor.app_command import app_command
from sdnator.supervisor.spec import PartProcess, PartSpec
from sdnator.up.lasting_keys import LASTING_KEYS
from sdnator.up.parts import UpParts
from sdnator.up.plan import StandingPlan

DISK_MIB = 1024
ARCHIVE_MIB = 300
"""Limit of the archive: an idle machine writes twice as much in half an hour."""
PREFIX = "chaos-"
"""Of the folder of a run; the process id follows."""
_LIBRARY = "*/faketime/libfaketimeMT.so.1"


def may_mount() -> bool:
    """Whether a small disk and veth pairs can be had."""
    return os.geteuid() == 0 and shutil.which("mount") is not None and shutil.which("ip") is not None


def faketime_library() -> Path | None:
    """libfaketime, where the package is installed."""
    return next(iter(Path("/usr/lib").glob(_LIBRARY)), None)


class _RelayedParts(UpParts):
    """Each controller reaches the switch through a relay of its own."""

    relays: Mapping[str, str]

    def settings(self, name: str) -> Mapping[str, Any]:
        """See `UpParts.settings`."""
        if name not in CONTROLLERS:
            return super().settings(name)
        found = super().settings(CONTROLLERS[0])
        return {
            **found,
            "switches": [
                {**each, "address": self.relays[name], "insecure": True} for each in found["switches"]
            ],
        }

    def standby_controller(self) -> PartProcess:
        """Start the second controller, which `sdnator up` has not."""
        name, folder = CONTROLLERS[1], self.plan.state / "standby"
        folder.mkdir(exist_ok=True)
        directory = self.plan.state / "due" / name
        backends, settings = self.backends(CONTROLLERS[0]), self.settings(name)
        command = app_command(CONTROLLERS[0], folder, backends, settings, directory=directory)
        return Child(name, [*command, "--log", self.plan.log_level], self.logs, heartbeat=True)


def remove_orphans() -> None:
    """Folders, with their disks, of runs that were killed before they could remove them."""
    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*-*"):
        owner = folder.name.split("-")[1]
        if owner.isdigit() and not Path(f"/proc/{owner}").exists():
            subprocess.run(["umount", "-l", str(folder / "disk")], capture_output=True, check=False)
            shutil.rmtree(folder, ignore_errors=True)


class ChaosStage:
    """All parts under the supervisor of `sdnator up`; a context manager.

    Args:
        folder: for the disk, sockets and what the probes keep.
        tell: gets the supervisor's words.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.told: list[str] = []
        self.clocks: dict[str, int] = {}
        """Seconds that a part's wall clock is off from its next start on."""
        self.restored: list[Path] = []
        """Copies that took the place of a damaged archive."""
        self._stack = ExitStack()
        self.disk = folder / "disk"
        self.disk.mkdir()
        self.wires: tuple[VethPair, VethPair] | None = None
        self.control: tuple[VethPair, VethPair] | None = None
        """Wires through a program that copies, instead of through the switch."""
        try:
            if may_mount():
                self._mount()
                self.wires = (
                    VethPair.make(self._stack, "ci"),
                    VethPair.make(self._stack, "co"),
                )
                self.control = (VethPair.make(self._stack, "cx"), VethPair.make(self._stack, "cy"))
                self._copy(self.control[0].far, self.control[1].near)
            self.parts = _RelayedParts(self._plan(), self._stack)
            self.links = {name: self._link(name) for name in APPS}
            self.switch_links = {name: self._link_to_switch(name) for name in CONTROLLERS}
            self.parts.relays = {name: link.url for name, link in self.switch_links.items()}
            specs = tuple(self._prepared(spec) for spec in self._specs())
            self.supervisor = Supervisor(specs, self._tell)
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self) -> Self:
        try:
            self.parts.logs.mkdir(parents=True)
            self.supervisor.start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End all parts, then what they stood on."""
        try:
            self.supervisor.stop()
        finally:
            self._stack.close()

    @property
    def archive(self) -> str:
        """URL of Data Archives."""
        return self.parts.plan.archive

    @property
    def archive_file(self) -> Path:
        """Where it stands."""
        return self.disk / "archive.db"

    @property
    def switch_address(self) -> str:
        """Of its P4Runtime server."""
        return self.parts.switch_address(self.parts.plan.switches[0])

    def spool(self, name: str) -> Path:
        """Where a part's engine keeps what the archive could not take."""
        return self.parts.plan.state / "due" / name

    def away(self) -> list[str]:
        """Parts that do not run now; `degraded` ones run, but have died often."""
        return [
            f"{each.name} ({each.state}: {each.cause})"
            for each in self.supervisor.reports()
            if each.state not in ("running", "degraded") or not Path(f"/proc/{each.pid}").exists()
        ]

    def _tell(self, text: str) -> None:
        self.told.append(f"{time.monotonic():.1f} {text}")

    def _mount(self) -> None:
        subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "sdnator-chaos", str(self.disk)], check=True
        )
        # lazily: a part that is still ending may have a file open
        self._stack.callback(subprocess.run, ["umount", "-l", str(self.disk)], check=False)

    def _copy(self, entry: str, leave: str) -> None:
        program = subprocess.Popen([sys.executable, "-m", "benchmarks.chaos_frames", entry, leave])
        self._stack.callback(program.wait)
        self._stack.callback(program.kill)

    def _plan(self) -> StandingPlan:
        ports = {1: "null", 2: "null"}
        if self.wires is not None:
            ports = {1: f"veth:{self.wires[0].far}", 2: f"veth:{self.wires[1].near}"}
        state = self.disk / "state"
        state.mkdir()
        token = self.folder / "token"
        token.write_text("a-token-of-the-benchmark\n")
        return StandingPlan(
            state=state,
            archive=f"sqlite://{self.archive_file}",
            switches=(PlannedSwitch(ports=ports, forward={1: 2, 2: 1}),),
            # reached within a run: what is in force has to outlive it, as do the numbers that probes archive
            settings={
                "coordinator": {
                    "retain_bytes": ARCHIVE_MIB << 20,
                    "lasting_keys": [*LASTING_KEYS, ARCHIVED],
                }
            },
            dashboard={"port": 0, "token_file": str(token)},
        )

    def _link(self, name: str) -> UnixLink:
        server = Path(self.parts.updates.removeprefix("unix://").rpartition("@")[2])
        link = UnixLink(self.folder / f"{name}.sock", server)
        self._stack.callback(link.close)
        return link

    def _link_to_switch(self, name: str) -> UnixLink:
        """A controller's way to the switch."""
        target = Path(self.switch_address.removeprefix("unix:"))
        link = UnixLink(self.folder / f"switch-{name}.sock", target)
        self._stack.callback(link.close)
        return link

    def _specs(self) -> Iterator[PartSpec]:
        """The parts of `sdnator up`, and a controller that stands by."""
        for spec in self.parts.specs():
            yield spec
            if spec.name == CONTROLLERS[0]:
                yield replace(spec, name=CONTROLLERS[1], start=self.parts.standby_controller)

    def _prepared(self, spec: PartSpec) -> PartSpec:
        if spec.name in APPS:
            return replace(spec, inside=lambda: self._around_app(spec.name))
        if spec.name == "updates":
            return replace(spec, inside=lambda: _environment(_server_clock(self.clocks.get("updates", 0))))
        return spec

    @contextmanager
    def _around_app(self, name: str) -> Iterator[None]:
        """The start of an app: its own way to Data Updates, and its own clock."""
        direct, self.parts.updates = self.parts.updates, self.links[name].url
        try:
            with _environment(self._python_clock(self.clocks.get(name, 0))):
                yield
        finally:
            self.parts.updates = direct

    def _python_clock(self, offset: int) -> dict[str, str]:
        """Environment of a Python program with a wrong wall clock.

        Not by libfaketime: `time.sleep` waits for an absolute monotonic time, and that library shifts it as if it
        were a wall time.
        """
        if not offset:
            return {}
        folder = self.folder / "clock"
        folder.mkdir(exist_ok=True)
        (folder / "sitecustomize.py").write_text(_WRONG_CLOCK)
        return {"PYTHONPATH": str(folder), "CHAOS_CLOCK_S": str(offset)}


_WRONG_CLOCK = """
import os, sys, time
offset, wall = int(os.environ["CHAOS_CLOCK_S"]), time.time_ns
time.time_ns = lambda: wall() + offset * 10**9
def wrong():
    # gRPC hands absolute times to its core, whose clock is right
    own = sys._getframe(1).f_globals.get("__name__", "").startswith("grpc")
    return (wall() if own else time.time_ns()) / 1e9
time.time = wrong
"""


def _server_clock(offset: int) -> dict[str, str]:
    library = faketime_library()
    if library is None or not offset:
        return {}
    return {"LD_PRELOAD": str(library), "FAKETIME": f"{offset:+d}", "FAKETIME_DONT_FAKE_MONOTONIC": "1"}


@contextmanager
def _environment(added: dict[str, str]) -> Iterator[None]:
    """What is started inside inherits these variables."""
    os.environ.update(added)
    try:
        yield
    finally:
        for variable in added:
            del os.environ[variable]
