"""Three network namespaces in a row, for enforcers on hosts: real packets from one to the others.

    sender ── gateway ── server      10.77.1.2 → 10.77.1.1 (input), 10.77.2.2 (forward); fd77:1::2 likewise

Linux, needs root and iproute2.  Everything is removed with the namespaces.
"""

import os
import select
import socket
import subprocess
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Final, Self

from sdnator import network_namespaces
from sdnator.errors import BadInput

SENDER_MAC: Final = "02:77:00:00:00:02"
SENDERS: Final = {4: "10.77.1.2", 6: "fd77:1::2"}
OTHERS: Final = {4: "10.77.1.3", 6: "fd77:1::3"}
"""A second address of the sender."""
INPUT: Final = {4: "10.77.1.1", 6: "fd77:1::1"}
FORWARD: Final = {4: "10.77.2.2", 6: "fd77:2::2"}
_HOSTS: Final = ("sender", "gateway", "server")
_ARRIVES_S: Final = 0.25


class RoutedLab:
    """The namespaces; a context manager.  Raises `BadInput` that says what the machine lacks."""

    def __init__(self) -> None:
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for host in _HOSTS:
                _ip("netns", "add", self.namespace(host))
                stack.callback(_forget, self.namespace(host))
            self._build()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def namespace(self, host: str) -> str:
        """Name of the namespace of `sender`, `gateway` or `server`."""
        return f"sdnl{os.getpid()}-{host}"

    def inside(self, host: str) -> AbstractContextManager[None]:
        """Sockets made and children started within live in the host's namespace."""
        return network_namespaces.inside(self.namespace(host))

    def path(self, target: str, source: str = "") -> "UdpPath":
        """A way for packets from the sender to an address of the gateway or server.

        Args:
            target: of INPUT or FORWARD.
            source: of SENDERS or OTHERS; empty: the first.
        """
        version = 6 if ":" in target else 4
        host = "gateway" if target in INPUT.values() else "server"
        family = socket.AF_INET6 if version == 6 else socket.AF_INET
        with self.inside(host):
            receiver = socket.socket(family, socket.SOCK_DGRAM)
            receiver.bind((target, 0))
        with self.inside("sender"):
            sender = socket.socket(family, socket.SOCK_DGRAM)
            sender.bind((source or SENDERS[version], 0))
        return UdpPath(sender, receiver)

    def nft(self, *arguments: str) -> str:
        """Run nft on the gateway, as another program would.

        Raises:
            BadInput: with what nft says.
        """
        return _run("ip", "netns", "exec", self.namespace("gateway"), "nft", *arguments)

    def _build(self) -> None:
        for host in _HOSTS:
            with self.inside(host):
                _write("net/ipv6/conf/default/accept_dad", 0)
                _write("net/ipv6/conf/all/accept_dad", 0)
        names = {host: self.namespace(host) for host in _HOSTS}
        for far, place in (("sender", 1), ("server", 2)):
            _ip(
                *("link", "add", "eth0", "netns", names[far], "type", "veth"),
                *("peer", "name", f"eth{place}", "netns", names["gateway"]),
            )
        _ip("-n", names["sender"], "link", "set", "eth0", "address", SENDER_MAC)
        _addresses(names["sender"], "eth0", *SENDERS.values(), *OTHERS.values())
        _addresses(names["gateway"], "eth1", *INPUT.values())
        _addresses(names["gateway"], "eth2", "10.77.2.1", "fd77:2::1")
        _addresses(names["server"], "eth0", *FORWARD.values())
        for host, side in (("sender", 1), ("server", 2)):
            _ip("-n", names[host], "route", "add", "default", "via", f"10.77.{side}.1")
            _ip("-n", names[host], "-6", "route", "add", "default", "via", f"fd77:{side}::1")
        with self.inside("gateway"):
            _write("net/ipv4/ip_forward", 1)
            _write("net/ipv6/conf/all/forwarding", 1)


class UdpPath:
    """A socket that sends and one that receives."""

    def __init__(self, sender: socket.socket, receiver: socket.socket) -> None:
        self._sender = sender
        self._receiver = receiver
        self._target = receiver.getsockname()
        self._number = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._sender.close()
        self._receiver.close()

    def send(self) -> int:
        """Send one packet; returns its number."""
        self._number += 1
        self._sender.sendto(self._number.to_bytes(8, "big"), self._target)
        return self._number

    def came(self, seconds: float = 0.0) -> list[int]:
        """Numbers of the packets that have arrived, after waiting for the first of them at most `seconds`."""
        numbers: list[int] = []
        while select.select([self._receiver], [], [], 0.0 if numbers else seconds)[0]:
            numbers.append(int.from_bytes(self._receiver.recv(64), "big"))
        return numbers

    def passes(self) -> bool:
        """Whether a packet that is sent now arrives within a quarter of a second."""
        number = self.send()
        return number in self.came(_ARRIVES_S)


def _addresses(namespace: str, interface: str, *addresses: str) -> None:
    _ip("-n", namespace, "link", "set", "lo", "up")
    _ip("-n", namespace, "link", "set", interface, "up")
    for each in addresses:
        rest = ("nodad",) if ":" in each else ()
        _ip("-n", namespace, "address", "add", f"{each}/{64 if ':' in each else 24}", "dev", interface, *rest)


def _write(name: str, value: int) -> None:
    Path("/proc/sys", name).write_text(str(value), encoding="ascii")


def _forget(namespace: str) -> None:
    subprocess.run(["ip", "netns", "delete", namespace], capture_output=True, check=False)


def _ip(*arguments: str) -> None:
    _run("ip", *arguments)


def _run(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise BadInput(f"{' '.join(command)}: {done.stderr.strip()}; this needs root and network namespaces")
    return done.stdout
