"""Hosts of a network, and rows of packet ends: MAC, address and switch port of each packet's sender or receiver."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from benchmarks.decision_traffic.traffic import Ints

BROADCAST_MAC: Final = (1 << 48) - 1


@dataclass(frozen=True)
class Host:
    """A machine behind one port of the switch."""

    name: str
    mac: int
    ip: int
    """IPv4."""
    port: int
    kind: str = "pc"
    """What it is: gateway, pc, server, printer, camera …"""
    open_ports: frozenset[int] = field(default_factory=frozenset)
    """TCP services; on any other port a SYN is answered by a RST, or by nothing where `filtered`."""
    filtered: bool = False
    """A host firewall drops what no service wants."""
    always_on: bool = True
    """Speaks at least every few minutes, day and night."""

    @property
    def ends(self) -> "Ends":
        """This host as a row of one."""
        return ends([self])


class Ends(NamedTuple):
    """One side of packets, in rows; a row of one stands for all packets."""

    mac: Ints
    ip: Ints
    port: Ints

    def at(self, rows: Ints) -> "Ends":
        """The rows with these numbers."""
        if len(self.mac) == 1:
            return self
        return Ends(self.mac[rows], self.ip[rows], self.port[rows])

    def spread(self, count: int) -> "Ends":
        """`count` rows."""
        if len(self.mac) == count:
            return self
        return Ends(*(np.broadcast_to(column, count) for column in self))


def ends(hosts: Sequence[Host]) -> Ends:
    """A row for each host."""
    return Ends(
        np.array([host.mac for host in hosts], np.int64),
        np.array([host.ip for host in hosts], np.int64),
        np.array([host.port for host in hosts], np.int64),
    )


def group(address: str) -> Ends:
    """A multicast or broadcast address with its MAC."""
    ip = ip_number(address)
    mac = 0x01005E000000 | (ip & 0x7FFFFF) if 224 <= ip >> 24 < 240 else BROADCAST_MAC
    return Ends(np.array([mac]), np.array([ip]), np.array([0]))


def ip_number(text: str) -> int:
    """10.0.0.1 as a number."""
    first, second, third, fourth = (int(part) for part in text.split("."))
    return first << 24 | second << 16 | third << 8 | fourth


def mac_text(mac: int) -> str:
    """Lower case with colons."""
    return int(mac).to_bytes(6, "big").hex(":")
