"""Columns of a batch → the rows that the trackers read."""

from collections.abc import Iterator
from itertools import repeat, starmap
from typing import Final

import numpy as np
import numpy.typing as npt

from apps.kitsune.afterimage import seconds
from apps.kitsune.behaviour.contacts import ARP, ECHO, OTHER, TCP, UDP, PacketRow
from apps.kitsune.kernel import Columns

_GROUP_BIT: Final = 1 << 40
_IPV6: Final = 1 << 128

SenderId = tuple[str, int, int, int]
"""Switch, ingress port, MAC, address as `address_of` makes it."""


def address_of(version: int, hi: int, lo: int) -> int:
    """One integer for an address of either version; 0 for none."""
    return lo if version != 6 else _IPV6 | hi << 64 | lo


def parts_of(address: int) -> tuple[int, int, int]:
    """Version, upper and lower half; the inverse of `address_of`."""
    if address >= _IPV6:
        return 6, address >> 64 & (1 << 64) - 1, address & (1 << 64) - 1
    return (4 if address else 0), 0, address


def packet_rows(batch: Columns, switch: str) -> Iterator[PacketRow]:
    """The rows of a batch, in order."""
    arp = batch["arp_op"] >= 0
    tcp, udp = batch["tcp_sport"] >= 0, batch["udp_sport"] >= 0
    echo = (batch["icmp_type"] == 8) | (batch["icmp6_type"] == 128)
    reply = (batch["icmp_type"] == 0) | (batch["icmp6_type"] == 129)
    base = np.select([arp, tcp, udp, echo | reply], [ARP, TCP, UDP, ECHO], OTHER).astype(np.int64)
    service = base + np.where(tcp, batch["tcp_dport"], np.where(udp, batch["udp_dport"], 0))
    reverse = base + np.where(tcp, batch["tcp_sport"], np.where(udp, batch["udp_sport"], 0))
    sources, targets = _addresses(batch, "src", arp), _addresses(batch, "dst", arp)
    group = (batch["eth_dst"] & _GROUP_BIT != 0) & ~(arp & (batch["arp_op"] == 1))
    # an ARP announcement asks for its own address; other ICMP and IP without ports begin nothing
    mute = (
        (batch["arp_op"] == 2)
        | reply
        | (arp & (batch["arp_src_ip"] == batch["arp_dst_ip"]))
        | (base == OTHER)
    )
    senders = zip(
        repeat(switch, len(arp)), batch["port"].tolist(), batch["eth_src"].tolist(), sources, strict=True
    )
    return starmap(
        PacketRow,
        zip(
            seconds(batch).tolist(),
            batch["arrival"].tolist(),
            senders,
            batch["eth_dst"].tolist(),
            sources,
            targets,
            service.tolist(),
            reverse.tolist(),
            batch["tcp_flags"].tolist(),
            tcp.tolist(),
            group.tolist(),
            (batch["quoted"] != 0).tolist(),
            mute.tolist(),
            batch["length"].tolist(),
            strict=True,
        ),
    )


def _addresses(batch: Columns, side: str, arp: npt.NDArray[np.bool_]) -> list[int]:
    low, version = batch[f"ip_{side}_lo"], batch["ip_version"]
    # received columns may hold anything: an IPv4 address has 32 bits, and a frame without IP none
    short = np.where(arp, batch[f"arp_{side}_ip"], np.where(version == 4, low & 0xFFFF_FFFF, 0))
    addresses: list[int] = short.tolist()
    for row in np.flatnonzero((version == 6) & ~arp).tolist():
        addresses[row] = _IPV6 | int(batch[f"ip_{side}_hi"][row]) << 64 | int(low[row])
    return addresses
