"""Entries and questions for the counting stages of p4/sdnator.p4, random and yet such that cells are used.

What random parameters seldom give: shared cells, thresholds that are reached, rings with keys that wait.
"""

from collections.abc import Iterator, Mapping
from random import Random

from dataplane.v1model.tables import Exact, Table, TableEntry, Ternary
from dataplane.v1model.tree import Program

_BITS = 8
_ALL = (1 << _BITS) - 1
_ADDRESS, _SHORT = (1 << 128) - 1, (1 << 16) - 1
_ZERO = 1 << 31
_BYTES = 60
_FIELDS = ("src", "dst", "l4", "sport", "dport")
Default = tuple[str, str, tuple[int, ...]]


def defaults(random: Random) -> list[Default]:
    """Table, action and parameters: a frame has the queries of its port, few want copies or digests."""
    matches: list[Default] = [
        (f"ingress.telemetry_{name}", f"ingress.match_{name}", (_ALL,)) for name in _FIELDS
    ]
    wants = (random.choice([0, 0, 1, 6]), random.choice([0, 0, 3, 12]))
    return [*matches, ("ingress.telemetry_active", "ingress.set_active", (_ALL, *wants))]


def entries(random: Random, tables: Mapping[str, Table], window_us: int) -> Iterator[tuple[str, TableEntry]]:
    """Table and entry: wires between ports 1 to 3, queries by port, and the stages' own."""
    for port in (1, 2, 3):
        yield "ingress.forward_port", TableEntry((Exact(port),), "ingress.to_port", (port % 3 + 1,))
        link = (Ternary(port, 511), Ternary(0, 0), Ternary(0, 0))
        queries = random.randrange(1, _ALL + 1)
        yield "ingress.telemetry_link", TableEntry(link, "ingress.match_link", (queries,), priority=port)
    stages = sum(name.startswith("ingress.count_") for name in tables)
    for stage in random.sample(range(stages), 4):
        name = f"ingress.count_{stage}.queries"
        actions = {each.name.rpartition(".")[2]: each for each in tables[name].spec.actions}
        kind = random.choice(["count", "difference", "difference", "gate"])
        shared = _shared(random, kind, stage, window_us)
        for priority, bit in enumerate(random.sample(range(_BITS), random.randint(1, 3)), start=1):
            given = {**shared, "query": bit, "bit_of_query": 1 << bit, **_own(random, bit)}
            params = tuple(given[param.name] for param in actions[kind].params)
            match = (Ternary(1 << bit, 1 << bit),)
            yield name, TableEntry(match, actions[kind].name, params, priority=priority)


def _shared(random: Random, kind: str, stage: int, window_us: int) -> dict[str, int]:
    """What frames of one difference have in common."""
    by_bytes = random.randint(0, 1)
    threshold = random.randint(1, 3) * (_BYTES if by_bytes else 1)
    masks = [(_ADDRESS, 0), (0, _ADDRESS), (1, 0), (1, 1), (_ADDRESS, _ADDRESS)]
    source_mask, destination_mask = random.choice(masks)
    return {
        "count_of": 100 + stage,
        "source_mask": source_mask,
        "destination_mask": destination_mask,
        "port_mask": random.choice([0, 0, _SHORT]),
        "source_port_mask": random.choice([0, 0, 1]),
        "length_mask": random.choice([0, 0, 0, _SHORT]),
        "threshold": threshold + (_ZERO if kind == "difference" else 0),
        "by_bytes": by_bytes,
        "reciprocal": -(-(1 << 64) // window_us),
        "base": random.choice([0, 50]),
        "size": random.choice([1, 2, 8, 64]),
        "generation": random.randint(1, 255),
    }


def _own(random: Random, bit: int) -> dict[str, int]:
    signs = {"answers": random.randint(0, 1), "subtracts": int(random.random() < 0.3)}
    gate = {"looks": int(random.random() < 0.3), "opens": 1 << _BITS + bit, "uncounted": 1 << 2 * _BITS + bit}
    return {**signs, **gate, "repeated": random.choice([0, 0, 1 << bit])}


def question(random: Random, time_us: int) -> dict[str, int]:
    """Fields of a packet-out that reads a cell, or sweeps and wants an answer."""
    operation = random.choice([1, 2, 2])
    return {
        "operation": operation,
        "query": random.randrange(_BITS),
        "key_source": random.choice([0, 1, 0x0A000000 + random.randint(1, 4)]),
        "key_destination": random.choice([0, 0, 0x0A000000 + random.randint(1, 4)]),
        "key_length": 1 if operation == 2 else 0,
        "timestamp": time_us,
    }


def packet_out(program: Program, given: Mapping[str, int]) -> bytes:
    """A packet_out header; fields that are not given are 0."""
    bits, width = 0, 0
    for field in program.headers["packet_out"].type.fields:
        bits = bits << field.width | given.get(field.name, 0)
        width += field.width
    return bits.to_bytes(width // 8, "big")
