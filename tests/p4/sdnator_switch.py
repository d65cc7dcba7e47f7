"""p4/sdnator.p4 on the embedded switch, and frames for it."""

from dataplane.compiler.machine import MachineMaker
from dataplane.v1model.switch import Replica, Switch
from dataplane.v1model.tables import TableEntry
from dataplane.v1model.tree import Program

CPU = 510
FLOOD, FLOOD_10 = 1, 2
PACKET_IN_BYTES = 52
_DIGEST = ("mac", "port", "timestamp", "vid")


def made(program: Program, maker: MachineMaker) -> Switch:
    """Ports 1 to 3; group 1 floods all of them, group 2 (for VLAN 10) the first two; copies go to the CPU."""
    switch = Switch(program, cpu_port=CPU, maker=maker)
    switch.set_ports([1, 2, 3])
    switch.set_clone_session(1, [Replica(CPU, 1)])
    switch.set_multicast_group(FLOOD, [Replica(port, port) for port in (1, 2, 3)])
    switch.set_multicast_group(FLOOD_10, [Replica(port, port) for port in (1, 2)])
    return switch


def mac(station: int) -> int:
    return 0x020000000000 + station


def ethernet(
    source: int, destination: int, payload: bytes = b"", *, etype: int = 0x0800, vid: int = 0
) -> bytes:
    """A frame between two MAC addresses, tagged when `vid` is not 0."""
    tag = b"\x81\0" + vid.to_bytes(2, "big") if vid else b""
    return (
        destination.to_bytes(6, "big") + source.to_bytes(6, "big") + tag + etype.to_bytes(2, "big") + payload
    )


def udp(
    source_port: int = 1000, destination_port: int = 53, *, protocol: int = 17, first: int = 0x45
) -> bytes:
    """An IPv4 packet from 10.0.0.1 to 10.0.0.2."""
    addresses = bytes([10, 0, 0, 1, 10, 0, 0, 2])
    head = bytes([first, 0, 0, 28, 0, 1, 0, 0, 64, protocol, 0, 0])
    ports = source_port.to_bytes(2, "big") + destination_port.to_bytes(2, "big")
    return head + addresses + ports + b"\0\x08\0\0"


def want_all(switch: Switch, *, copies: int = 0, digests: int = 0) -> None:
    """Query 0 matches every frame."""
    for name in ("link", "src", "dst", "l4", "sport", "dport"):
        switch.tables[f"ingress.telemetry_{name}"].set_default(f"ingress.match_{name}", (1,))
    switch.tables["ingress.telemetry_active"].set_default("ingress.set_active", (1, copies, digests))


def entry(match: tuple, action: str, *params: int, priority: int = 0) -> TableEntry:
    return TableEntry(match, f"ingress.{action}", params, priority)
