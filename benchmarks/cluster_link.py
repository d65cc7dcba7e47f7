"""Two sites as network namespaces, and a slow link between them that can be cut without either end noticing.

    near ─veth─┐ tbf              tbf ┌─veth─ far          10.78.0.1 ↔ 10.78.0.2
               └── wire: paper_relay ─┘

Limits come from tbf, one-way latency from `paper_relay`, since kernels may have no netem.  Linux, needs root,
iproute2, ethtool and setpriv.  Everything is removed with the namespaces.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, Final, Self

ADDRESSES: Final[Mapping[str, str]] = MappingProxyType({"near": "10.78.0.1", "far": "10.78.0.2"})
_MACS: Final = {"near": "02:78:00:00:00:01", "far": "02:78:00:00:00:02"}
_OTHER: Final = {"near": "far", "far": "near"}
_ROOT: Final = Path(__file__).parents[1]
_QUEUE: Final = ("burst", "16kb", "latency", "100ms")
"""Of the router in front of the slow link: as much as fills the link for a round trip."""


class SlowLink:
    """The namespaces `near` and `far`, joined; a context manager.

    Args:
        mbit: limit each way, Mb/s.
        one_way_s: latency each way.
    """

    def __init__(self, mbit: float = 10.0, one_way_s: float = 0.05) -> None:
        self.mbit = mbit
        self.one_way_s = one_way_s
        self._wire = f"sbl{os.getpid()}-wire"
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Make them; raises OSError, RuntimeError that say what the machine lacks."""
        if os.geteuid() != 0:
            raise RuntimeError("network namespaces need root")
        with ExitStack() as stack:
            for name in (self._wire, *map(self.namespace, ADDRESSES)):
                _ip("netns", "add", name)
                stack.callback(_ip, "netns", "del", name)
                _ip("-n", name, "link", "set", "lo", "up")
            for site in ADDRESSES:
                self._plug_in(site)
            self.mend()
            self._delay(stack)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def namespace(self, site: str) -> str:
        """Name of the namespace of `near` or `far`."""
        return f"sbl{os.getpid()}-{site}"

    def start(self, site: str, command: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
        """Start a program in a site, with pipes for its input and output; it ends with this process.

        Args:
            site: `near`, `far`.
            command: program and arguments.
            log: file for its standard error.
        """
        with log.open("ab") as errors:
            return self._run(self.namespace(site), command, errors)

    def cut(self) -> None:
        """From now on nothing that is sent arrives; neither end is told."""
        for site in ADDRESSES:
            self._shape(site, "pfifo", "limit", "0")

    def mend(self) -> None:
        """As before."""
        for site in ADDRESSES:
            self._shape(site, "tbf", "rate", f"{self.mbit:g}mbit", *_QUEUE)

    def carried(self) -> dict[str, int]:
        """Bytes that have left the link, by the site that they went to."""
        done = _ran("ip", "-n", self._wire, "-s", "-j", "link", "show")
        told = {one["ifname"]: one["stats64"]["tx"]["bytes"] for one in json.loads(done)}
        return {site: int(told[site]) for site in ADDRESSES}

    def _plug_in(self, site: str) -> None:
        inside = self.namespace(site)
        _ip(
            "-n", inside, "link", "add", "up0", "address", _MACS[site], "type", "veth",
            "peer", "name", site, "netns", self._wire,
        )  # fmt: skip
        _ip("-n", inside, "addr", "add", f"{ADDRESSES[site]}/24", "dev", "up0")
        # frames pass through a program: their checksums must be there, and none may be longer than the MTU
        features = ("tx", "off", "tso", "off", "gso", "off", "gro", "off")
        _ran("ip", "netns", "exec", inside, "ethtool", "-K", "up0", *features)
        _ip("-n", inside, "link", "set", "up0", "up")
        _ip("-n", self._wire, "link", "set", site, "up")
        # a cut far away is not noticed as a neighbour that is gone would be
        other = _OTHER[site]
        entry = ("lladdr", _MACS[other], "dev", "up0", "nud", "permanent")
        _ip("-n", inside, "neigh", "replace", ADDRESSES[other], *entry)

    def _shape(self, site: str, *discipline: str) -> None:
        _ran("tc", "-n", self._wire, "qdisc", "replace", "dev", site, "root", *discipline)

    def _delay(self, stack: ExitStack) -> None:
        command = [sys.executable, "-m", "benchmarks.paper_relay", "near,far"]
        relay = self._run(self._wire, command, None)
        stack.callback(end_program, relay)
        assert relay.stdin is not None
        assert relay.stdout is not None
        if relay.stdout.readline() != b"ready\n":
            raise RuntimeError("the relay of the slow link did not start")
        relay.stdin.write(f"{self.one_way_s}\n".encode())
        relay.stdin.flush()

    def _run(
        self, namespace: str, command: Sequence[str], errors: IO[bytes] | None
    ) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            ["ip", "netns", "exec", namespace, "setpriv", "--pdeathsig", "KILL", *command],
            cwd=_ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
        )


def end_program(process: subprocess.Popen[Any]) -> None:
    """kill -9."""
    process.kill()
    process.wait(30)
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()


def _ip(*arguments: str) -> None:
    _ran("ip", *arguments)


def _ran(*command: str) -> str:
    """What it printed; raises OSError that says what failed."""
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    if done.returncode:
        raise OSError(f"{' '.join(command)}: {done.stderr.strip()[:300]}")
    return done.stdout
