"""Counting stages of p4/sdnator.p4 on the embedded switch: entries, frames, questions, and what comes out.

Frames are told apart by their port: those of port p are query p - 1's.
"""

from typing import NamedTuple

from dataplane.compiler.machine import BatchResult
from dataplane.v1model.externs import DataplaneError
from dataplane.v1model.switch import Switch
from dataplane.v1model.tables import TableEntry, Ternary
from tests.p4.sdnator_switch import PACKET_IN_BYTES, ethernet, mac, want_all

ADDRESS, SHORT = (1 << 128) - 1, (1 << 16) - 1
ZERO = 1 << 31
"""In the cell of a difference."""
ADDS, ANSWERS, SUBTRACTS = 1, 2, 3
"""Ports: a frame counts its source up, its destination up, its destination down."""
FRAME_BYTES = 42
_FIELDS = (("egress_port", 9), ("operation", 7), ("query", 32), ("source", 128), ("destination", 128))
_FIELDS += (("port", 16), ("length", 16), ("source_port", 16), ("timestamp", 48))


class Count(NamedTuple):
    """A count digest."""

    query: int
    window: int
    count: int
    host: int


class Told(NamedTuple):
    """Which queries a frame digest names."""

    queries: int
    crossed: int
    overflow: int


class Answer(NamedTuple):
    """What a question about a cell, or for a sweep, brings back."""

    count: int
    window: int
    overflow: bool


def clear_cells(switch: Switch) -> None:
    for name in ("cells", "waiting", "rings"):
        array = switch.registers[f"ingress.{name}"]
        for index, _ in array.written():
            array.write(index, 0)


def want_by_port(switch: Switch, *, copies: int = 0, digests: int = 0) -> None:
    """Frames of port p are query p - 1's."""
    want_all(switch)
    for name in ("src", "dst", "l4", "sport", "dport"):
        switch.tables[f"ingress.telemetry_{name}"].set_default(f"ingress.match_{name}", (ADDRESS,))
    for port in (ADDS, ANSWERS, SUBTRACTS):
        match = (Ternary(port, 511), Ternary(0, 0), Ternary(0, 0))
        entry = TableEntry(match, "ingress.match_link", (1 << (port - 1),), priority=1)
        switch.tables["ingress.telemetry_link"].insert(entry)
    switch.tables["ingress.telemetry_active"].set_default("ingress.set_active", (ADDRESS, copies, digests))


def install(switch: Switch, action: str, bit: int, *, stage: int = 0, **params: int) -> None:
    """An entry of a stage for one bit of the query map; parameters that are not named are 0."""
    table = switch.tables[f"ingress.count_{stage}.queries"]
    spec = next(each for each in table.spec.actions if each.name == f"ingress.count_{stage}.{action}")
    given = {"bit_of_query": 1 << bit, "source_mask": ADDRESS, **params}
    unknown = set(params) - {param.name for param in spec.params}
    if unknown:
        raise DataplaneError(f"{spec.name} has no parameter {unknown}")
    values = tuple(given.get(param.name, 0) for param in spec.params)
    table.insert(TableEntry((Ternary(1 << bit, 1 << bit),), spec.name, values, priority=1 + bit))


def difference(
    switch: Switch,
    threshold: int,
    window_us: int,
    *,
    stage: int = 0,
    count_of: int = 0,
    size: int = 1024,
    base: int = 0,
    by_bytes: int = 0,
    generation: int = 1,
) -> None:
    """Frames of a host, and to it from port ANSWERS, less those to it from port SUBTRACTS."""
    common = {"threshold": ZERO + threshold, "reciprocal": -(-(1 << 64) // window_us), "count_of": count_of}
    common |= {"base": base, "size": size, "by_bytes": by_bytes, "generation": generation}
    for port in (ADDS, ANSWERS, SUBTRACTS):
        signs = {"answers": int(port != ADDS), "subtracts": int(port == SUBTRACTS)}
        install(switch, "difference", port - 1, stage=stage, **common, **signs)


def send(switch: Switch, port: int, host: int, now_us: int, *, more: int = 0) -> BatchResult:
    """A frame that counts `host` up or down, `more` bytes longer than the shortest."""
    source, destination = (host, 250) if port == ADDS else (250, host)
    length = (FRAME_BYTES - 14 + more).to_bytes(2, "big")
    head = b"\x45\0" + length + bytes([0, 1, 0, 0, 64, 17, 0, 0, 10, 0, 0, source, 10, 0, 0, destination])
    packet = head + b"\x03\xe8\0\x35\0\x08\0\0" + bytes(more)
    return switch.process(port, ethernet(mac(1), mac(2), packet), now_us)


def counts(result: BatchResult) -> list[Count]:
    rows = [each.values for each in result.digests if each.name == "count_digest_t"]
    return [
        Count(row[0], row[1], row[2] - (1 << 32 if row[2] >> 31 else 0), row[3] - 0x0A000000) for row in rows
    ]


def told(result: BatchResult) -> list[Told]:
    return [Told(*each.values[:3]) for each in result.digests if each.name == "frame_digest_t"]


def ask(switch: Switch, now_us: int = 20, **header: int) -> Answer | None:
    """A packet-out that asks for a cell (or what `operation` says) → the answer, if there is one."""
    return answer(question(switch, now_us, **header))


def question(switch: Switch, now_us: int, **header: int) -> BatchResult:
    values = {"operation": 1, **header}
    bits = 0
    for name, width in _FIELDS:
        bits = bits << width | values.get(name, 0)
    return switch.packet_out(bits.to_bytes(sum(width for _, width in _FIELDS) // 8, "big"), now_us)


def answer(result: BatchResult) -> Answer | None:
    assert len(result.packet_ins) <= 1
    for packet in result.packet_ins:
        assert len(packet) == PACKET_IN_BYTES
        return Answer(
            int.from_bytes(packet[12:16], "big"), int.from_bytes(packet[16:20], "big"), any(packet[20:52])
        )
    return None


def sweep(switch: Switch, now_us: int, *, always: bool = False, query: int = 0) -> BatchResult:
    """A packet-out that takes a cell out of the query's ring."""
    return question(switch, now_us, operation=2, query=query, length=int(always))
