"""Four network namespaces: attacker, client and victim, each on a veth of the switch in the fourth.

    attacker ── p1 ┐
    client ─── p2 ─┤ switch      addresses and neighbours are fixed, so that nobody needs ARP
    victim ─── p3 ─┘

IPv4 and IPv6 side by side.  Everything is removed with the namespaces.  Linux, needs root and iproute2.
"""

import ipaddress
import os
import shutil
import socket
import subprocess
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from dataplane.ports.veth_port import turn_off_offloads
from sdnator import network_namespaces
from sdnator.errors import BadInput

HOSTS: Final = ("attacker", "client", "victim")
PORT: Final = 80
BACKLOG: Final = 128
SYNACK_RETRIES: Final = 2
"""A half-open connection lives 1 + 2 + 4 s."""
HALF_OPEN_S: Final = 7
_VICTIM_SYSCTLS: Final = {
    "net/ipv4/tcp_syncookies": 0,
    "net/ipv4/tcp_max_syn_backlog": BACKLOG,
    "net/core/somaxconn": BACKLOG,
    "net/ipv4/tcp_synack_retries": SYNACK_RETRIES,
    "net/ipv4/tcp_no_metrics_save": 1,
}
_CLIENT_TIMING: Final = ("net/ipv4/tcp_syn_retries", "net/ipv4/tcp_syn_linear_timeouts")
"""Kernels since 6.5 repeat the first SYNs each second, older ones after 1, 3, 7 s."""
_ANY_ADDRESS: Final = {"net/ipv4/ip_nonlocal_bind": 1, "net/ipv6/ip_nonlocal_bind": 1}


@dataclass(frozen=True)
class LabAddresses:
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
    services: str
    """The victim has all of these: a flood of its own for each, and none waits for another's backlog."""

    def is_client(self, target: str) -> bool:
        """Whether an address, or a prefix, has to do with any client's."""
        network = ipaddress.ip_network(target, strict=False)
        return network.version == self.version and network.overlaps(ipaddress.ip_network(self.clients))

    def service(self, number: int) -> str:
        """Address of a service, from 1."""
        return str(ipaddress.ip_network(self.services)[number])


PLANS: Final = {
    4: LabAddresses(4, "10.0.0.2", "10.0.0.3", "10.0.0.1", 24, "10.1.0.0/16", "10.2.0.0/16", "10.3.0.0/16"),
    6: LabAddresses(
        6, "fd00::2", "fd00::3", "fd00::1", 64, "fd00:0:0:1::/64", "fd00:0:2::/48", "fd00:0:0:3::/64"
    ),
}


def mac(host: str) -> str:
    """The MAC address of a host."""
    return f"02:00:00:00:00:0{HOSTS.index(host) + 1}"


class Lab:
    """The namespaces; a context manager.  Raises `BadInput` that says what the machine lacks."""

    def __init__(self) -> None:
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

    def settings(self) -> dict[str, int]:
        """What decides how a flood hurts, as the kernel has it."""
        with self.inside("victim"):
            found = {name: _read(name) for name in _VICTIM_SYSCTLS}
        with self.inside("client"):
            found |= {name: _read(name) for name in _CLIENT_TIMING if Path("/proc/sys", name).exists()}
        return {name.rpartition("/")[2]: value for name, value in found.items()}

    def flush_metrics(self) -> None:
        """Forget what the victim's kernel knows of its peers: it keeps backlog for proven ones."""
        _ip("-n", self.namespace("victim"), "tcp_metrics", "flush", "all")

    def inside(self, host: str) -> AbstractContextManager[None]:
        """Children started within live in the host's namespace."""
        return network_namespaces.inside(self.namespace(host))

    def _build(self) -> None:
        for host in ("switch", *HOSTS):
            _ip("netns", "add", self.namespace(host))
            self._made.append(self.namespace(host))
        self._sysctl("switch", {"net/ipv6/conf/default/disable_ipv6": 1})
        _ip("-n", self.namespace("switch"), "link", "set", "lo", "up")
        for number, host in enumerate(HOSTS, start=1):
            self._connect(number, host)
            _batch(self.namespace(host), [line for plan in PLANS.values() for line in _addresses(plan, host)])
        for host in HOSTS:
            _batch(self.namespace(host), [line for plan in PLANS.values() for line in _routes(plan, host)])
        for host in ("client", "victim"):
            self._sysctl(host, _ANY_ADDRESS)
        self._sysctl("victim", _VICTIM_SYSCTLS)
        self.flush_metrics()

    def _connect(self, number: int, host: str) -> None:
        # no router solicitations to carry, no waiting for duplicate addresses
        quiet = {"net/ipv6/conf/default/accept_dad": 0, "net/ipv6/conf/default/router_solicitations": 0}
        self._sysctl(host, quiet)
        _ip(
            *("link", "add", "eth0", "netns", self.namespace(host), "address", mac(host), "type", "veth"),
            *("peer", "name", f"p{number}", "netns", self.namespace("switch")),
        )
        _ip("-n", self.namespace("switch"), "link", "set", f"p{number}", "up")
        _batch(self.namespace(host), ["link set lo up", "link set eth0 up"])
        # the switch reads frames as the kernel leaves them: with checksums that the sender's card would fill in
        with self.inside(host), socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as opened:
            turn_off_offloads(opened, "eth0")

    def _sysctl(self, host: str, values: dict[str, int]) -> None:
        with self.inside(host):
            for name, value in values.items():
                Path("/proc/sys", name).write_text(str(value), encoding="ascii")


def _addresses(plan: LabAddresses, host: str) -> list[str]:
    extra = " nodad" if plan.version == 6 else ""
    others = [other for other in HOSTS if other != host]
    return [
        f"address add {getattr(plan, host)}/{plan.bits} dev eth0{extra}",
        *(f"neigh replace {getattr(plan, other)} lladdr {mac(other)} dev eth0" for other in others),
    ]


def _routes(plan: LabAddresses, host: str) -> list[str]:
    """Answers to forged addresses go to the attacker, who does not forward or answer them."""
    if host == "client":
        return [f"route add local {plan.clients} dev lo", f"route add {plan.services} via {plan.victim}"]
    if host == "victim":
        return [
            f"route add local {plan.services} dev lo",
            f"route add {plan.clients} via {plan.client}",
            f"route add default via {plan.attacker}",
        ]
    return []


def _read(name: str) -> int:
    return int(Path("/proc/sys", name).read_text(encoding="ascii"))


def _check_machine() -> None:
    if os.geteuid() != 0:
        raise BadInput("the SYN flood demo makes network namespaces: run it as root")
    if shutil.which("ip") is None:
        raise BadInput("the SYN flood demo needs the program ip: install iproute2")


def _ip(*arguments: str, lines: str = "") -> None:
    done = subprocess.run(["ip", *arguments], input=lines, capture_output=True, text=True, check=False)
    if done.returncode:
        raise BadInput(
            f"ip {' '.join(arguments)}: {done.stderr.strip()}; the demo needs network namespaces and veth"
        )


def _batch(namespace: str, lines: list[str]) -> None:
    if lines:
        _ip("-n", namespace, "-batch", "-", lines="\n".join(lines) + "\n")
