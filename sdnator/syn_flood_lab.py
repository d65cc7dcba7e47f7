"""Four network namespaces: attacker, client and victim, each on a veth of the switch in the fourth.

    attacker ── p1 ┐
    client ─── p2 ─┤ switch      addresses and neighbours are fixed, so that nobody needs ARP
    victim ─── p3 ─┘

Everything is removed with the namespaces.  Linux, needs root and iproute2.
"""

import ctypes
import os
import shutil
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from dataplane.veth_port import turn_off_offloads
from sdnator.errors import BadInput

HOSTS: Final = ("attacker", "client", "victim")
PORT: Final = 80
BACKLOG: Final = 128
SYNACK_RETRIES: Final = 2
"""A half-open connection lives 1 + 2 + 4 s."""
HALF_OPEN_S: Final = 7
_CLONE_NEWNET: Final = 0x4000_0000
_VICTIM_SYSCTLS: Final = {
    "net/ipv4/tcp_syncookies": 0,
    "net/ipv4/tcp_max_syn_backlog": BACKLOG,
    "net/core/somaxconn": BACKLOG,
    "net/ipv4/tcp_synack_retries": SYNACK_RETRIES,
    "net/ipv4/tcp_no_metrics_save": 1,
}


@dataclass(frozen=True)
class Plan:
    """Addresses of the lab in one IP version."""

    version: int
    attacker: str
    client: str
    victim: str
    bits: int
    clients: str
    """The client answers for all addresses of this prefix."""
    attackers: str
    """Nobody answers for these."""


PLANS: Final = {
    4: Plan(4, "10.0.0.2", "10.0.0.3", "10.0.0.1", 24, "10.1.0.0/16", "10.2.0.0/16"),
    6: Plan(6, "fd00::2", "fd00::3", "fd00::1", 64, "fd00:0:0:1::/64", "fd00:0:0:2::/64"),
}


def mac(host: str) -> str:
    """The MAC address of a host."""
    return f"02:00:00:00:00:0{HOSTS.index(host) + 1}"


class Lab:
    """The namespaces; a context manager.  Raises `BadInput` that says what the machine lacks."""

    def __init__(self, version: int = 4) -> None:
        self.plan = PLANS[version]
        self._made: list[str] = []

    def namespace(self, host: str) -> str:
        return f"sdn{os.getpid()}-{host}"

    def __enter__(self) -> Self:
        _check_machine()
        try:
            self._build()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Remove the namespaces, and with them their interfaces."""
        while self._made:
            subprocess.run(["ip", "netns", "delete", self._made.pop()], capture_output=True, check=False)

    def _build(self) -> None:
        for host in ("switch", *HOSTS):
            _ip("netns", "add", self.namespace(host))
            self._made.append(self.namespace(host))
            self._in(host, "link", "set", "lo", "up")
        self._sysctl("switch", {"net/ipv6/conf/default/disable_ipv6": 1})
        for number, host in enumerate(HOSTS, start=1):
            self._connect(number, host)
        for host in HOSTS:
            for other in HOSTS:
                if other != host:
                    address = getattr(self.plan, other)
                    self._in(host, "neigh", "replace", address, "lladdr", mac(other), "dev", "eth0")
        self._routes()
        self._sysctl("victim", _VICTIM_SYSCTLS)
        self.flush_metrics()

    def _connect(self, number: int, host: str) -> None:
        # no segmentation offload to undo, no router solicitations to carry
        self._sysctl(
            host, {"net/ipv6/conf/default/accept_dad": 0, "net/ipv6/conf/default/router_solicitations": 0}
        )
        _ip(
            *("link", "add", "eth0", "netns", self.namespace(host), "address", mac(host), "type", "veth"),
            *("peer", "name", f"p{number}", "netns", self.namespace("switch")),
        )
        self._in("switch", "link", "set", f"p{number}", "up")
        self._in(host, "link", "set", "eth0", "up")
        # the switch reads frames as the kernel leaves them: with checksums that the sender's card would fill in
        with self.inside(host), socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as opened:
            turn_off_offloads(opened, "eth0")
        extra = ("nodad",) if self.plan.version == 6 else ()
        address = f"{getattr(self.plan, host)}/{self.plan.bits}"
        self._in(host, "address", "add", address, "dev", "eth0", *extra)

    def _routes(self) -> None:
        self._in("client", "route", "add", "local", self.plan.clients, "dev", "lo")
        self._sysctl("client", {f"net/ipv{self.plan.version}/ip_nonlocal_bind": 1})
        self._in("victim", "route", "add", self.plan.clients, "via", self.plan.client)
        # answers to forged addresses go to the attacker, who does not forward or answer them
        self._in("victim", "route", "add", "default", "via", self.plan.attacker)

    def flush_metrics(self) -> None:
        """Forget what the victim's kernel knows of its peers: it keeps backlog for proven ones."""
        self._in("victim", "tcp_metrics", "flush", "all")

    def half_open(self) -> int:
        """Half-open connections at the victim now."""
        command = ["ip", "netns", "exec", self.namespace("victim"), "ss", "-Htn", "state", "syn-recv"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        return len(done.stdout.splitlines())

    @contextmanager
    def inside(self, host: str) -> Iterator[None]:
        """Children started within live in the host's namespace."""
        home = os.open(f"/proc/self/task/{threading.get_native_id()}/ns/net", os.O_RDONLY)
        try:
            _enter(Path("/run/netns") / self.namespace(host))
            yield
        finally:
            _set_namespace(home)
            os.close(home)

    def _in(self, host: str, *arguments: str) -> None:
        family = ("-6",) if self.plan.version == 6 and arguments[0] in ("route", "neigh") else ()
        _ip("-n", self.namespace(host), *family, *arguments)

    def _sysctl(self, host: str, values: dict[str, int]) -> None:
        with self.inside(host):
            for name, value in values.items():
                Path("/proc/sys", name).write_text(str(value), encoding="ascii")


def _enter(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        _set_namespace(descriptor)
    finally:
        os.close(descriptor)


def _set_namespace(descriptor: int) -> None:
    library = ctypes.CDLL(None, use_errno=True)
    if library.setns(descriptor, _CLONE_NEWNET) != 0:
        number = ctypes.get_errno()
        raise BadInput(f"entering a network namespace: {os.strerror(number)}; run as root")


def _check_machine() -> None:
    if os.geteuid() != 0:
        raise BadInput("the SYN flood demo makes network namespaces: run it as root")
    for program in ("ip", "ss"):
        if shutil.which(program) is None:
            raise BadInput(f"the SYN flood demo needs the program {program}: install iproute2")


def _ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise BadInput(
            f"ip {' '.join(arguments)}: {done.stderr.strip()}; the demo needs network namespaces and veth"
        )
