"""Hosts in two network namespaces, a wire from each to this machine's switch, and `sdnator up` on the two wires.

    namespace of the office ─ veth ─► port 1 ─ switch ─ port 2 ◄─ veth ─ namespace of the Internet

What was offered and what came is told by the kernel's counters of the ends in the namespaces.  Linux, root.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.worker import end_in_order
from dataplane.bmv2 import ending_with_us
from sdnator.errors import PipelineError
from sdnator.network_namespaces import inside
from sdnator.northbound import ask
from sdnator.up import running

_START_S: Final = 180.0
_CABLE_S: Final = 30.0
_POLL_S: Final = 0.02
_OURS: Final = re.compile(r"sdnlive(\d+)[ab]")


@dataclass(frozen=True)
class HostWire:
    """A veth pair with one end in a namespace of its own."""

    namespace: str
    host: str
    """The end there."""
    switch: str
    """The end here."""

    @classmethod
    def make(cls, stack: ExitStack, side: str) -> "HostWire":
        """A wire with names of this process that is removed with `stack`.

        Args:
            stack: of what ends with the measurement.
            side: a or b.
        """
        made = cls(f"sdnlive{os.getpid()}{side}", "eth0", f"sdnlive{os.getpid()}{side}")
        _ip("netns", "add", made.namespace)
        stack.callback(_ip, "netns", "delete", made.namespace)
        pair = ("type", "veth", "peer", "name", made.host, "netns", made.namespace)
        with inside(made.namespace):  # the kernel sends no frames of its own
            Path("/proc/sys/net/ipv6/conf/default/disable_ipv6").write_text("1", encoding="ascii")
        _ip("link", "add", made.switch, *pair)
        stack.callback(_ip, "link", "delete", made.switch)
        Path(f"/proc/sys/net/ipv6/conf/{made.switch}/disable_ipv6").write_text("1", encoding="ascii")
        _ip("-n", made.namespace, "link", "set", made.host, "up")
        _ip("link", "set", made.switch, "up")
        made._wait()
        return made

    def counted(self) -> Mapping[str, int]:
        """`sent` and `came` of the end in the namespace, and `dropped`: what it could not send."""
        shown = _ip("-n", self.namespace, "-json", "-statistics", "link", "show", "dev", self.host)
        told = json.loads(shown)[0]["stats64"]
        tx, rx = told["tx"], told["rx"]
        dropped = int(tx["dropped"]) + int(tx["errors"])
        return {"sent": int(tx["packets"]), "came": int(rx["packets"]), "dropped": dropped}

    def _wait(self) -> None:
        """Frames that are sent before there is a carrier are dropped without an error."""
        state = Path("/sys/class/net", self.switch, "operstate")
        deadline = time.monotonic() + _CABLE_S
        while state.read_text(encoding="ascii").strip() != "up":
            if time.monotonic() > deadline:
                raise PipelineError(f"{self.switch} has no carrier after {_CABLE_S:.0f} s")
            time.sleep(_POLL_S)


def possible() -> bool:
    """Namespaces need root and `ip`."""
    return os.geteuid() == 0 and shutil.which("ip") is not None


@contextmanager
def wires() -> Iterator[tuple[HostWire, HostWire]]:
    """Wires of the office and of the Internet."""
    _remove_orphans()
    with ExitStack() as stack:
        yield HostWire.make(stack, "a"), HostWire.make(stack, "b")


def _remove_orphans() -> None:
    """Namespaces of processes that were killed before they could remove them."""
    with suppress(OSError):
        for each in Path("/run/netns").iterdir():
            found = _OURS.fullmatch(each.name)
            if found and not Path("/proc", found[1]).exists():
                _ip("netns", "delete", each.name)


def _ip(*arguments: str) -> str:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise PipelineError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout


class UpProcess:
    """`sdnator up` with its default settings, in folders of its own; a context manager.

    Args:
        folder: for state, data and configuration.
        ports: `N=veth:INTERFACE`.
    """

    def __init__(self, folder: Path, *ports: str) -> None:
        self._folder = folder
        self._command = [str(Path(sys.executable).with_name("sdnator")), "up", "--json"]
        for each in ports:
            self._command += ["--port", each]
        self._log = folder / "up.log"

    def __enter__(self) -> "UpProcess":
        kinds = ("STATE", "DATA", "CONFIG")
        places = {f"XDG_{kind}_HOME": str(self._folder / kind.lower()) for kind in kinds}
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                ending_with_us(self._command),
                env={**os.environ, **places},
                cwd=self._folder,
                stdout=log,
                stderr=log,
            )
        try:
            self._coordinator = self._wait()
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _wait(self) -> str:
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline and self._process.poll() is None:
            found = running.find(self._folder / "state" / "sdnator")
            if found is not None and found.coordinator:
                self.parts = dict(found.parts)
                return found.coordinator
            time.sleep(_POLL_S)
        raise PipelineError(f"no pipeline: {self._log.read_text(encoding='utf-8')[-2000:]}")

    def _end(self) -> None:
        end_in_order(self._process)

    def health(self) -> Mapping[str, Any]:
        """What the apps last told the Coordinator, by app."""
        told: Mapping[str, Any] = ask(self._coordinator, "/health")
        return told
