"""The texts that identify a packet's streams, for the Python twin of the kernel.

Concatenated without a separator, as published: "192.168.2.1" + "10123" and "192.168.2.110" + "123"
are one stream.
"""

from collections.abc import Iterator
from typing import NamedTuple

from apps.kitsune.kernel import PACKET_FIELDS, Columns
from apps.kitsune.names import ip_text, mac_text


class TextKeys(NamedTuple):
    """Size, time and keys of one packet."""

    length: float
    time: float
    sender: str
    source: str
    destination: str
    source_socket: str
    destination_socket: str


def text_keys(columns: Columns) -> Iterator[TextKeys]:
    """Keys of each row of the kernel's columns."""
    names = [name for name, _, _ in PACKET_FIELDS]
    for row in zip(*(columns[name].tolist() for name in names), strict=True):
        yield _keys(dict(zip(names, row, strict=True)))


def _keys(row: dict[str, float]) -> TextKeys:
    packet = {name: int(value) for name, value in row.items() if name != "time"}
    macs = mac_text(packet["eth_src"]), mac_text(packet["eth_dst"])
    version = packet["ip_version"]
    source = ip_text(version, packet["ip_src_hi"], packet["ip_src_lo"])
    destination = ip_text(version, packet["ip_dst_hi"], packet["ip_dst_lo"])
    ports = _port(packet["tcp_sport"]) + _port(packet["udp_sport"])
    peer_ports = _port(packet["tcp_dport"]) + _port(packet["udp_dport"])
    sockets = source + ports, destination + peer_ports
    if not ports and packet["arp_op"] >= 0:
        source, destination = ip_text(4, 0, packet["arp_src_ip"]), ip_text(4, 0, packet["arp_dst_ip"])
        sockets = macs
    elif not ports and packet["icmp_type"] >= 0:
        sockets = source + "icmp", destination + "icmp"
    elif not (source or ports or destination or peer_ports):
        source, destination = sockets = macs
    return TextKeys(packet["length"], row["time"], macs[0] + source, source, destination, *sockets)


def _port(port: int) -> str:
    return "" if port < 0 else str(port)
