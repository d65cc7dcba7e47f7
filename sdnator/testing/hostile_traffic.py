"""Entries and packet-outs for p4/sdnator.p4 as a controller gone wrong may send them.

All are valid by the p4info.  Cells lie across banks, beyond their stage or nowhere; entries of one query do not
agree about its cells; packet-outs ask for anything.
"""

from collections.abc import Iterator, Mapping, Sequence
from random import Random

from dataplane.v1model.tables import Table, TableEntry, Ternary
from dataplane.v1model.tree import ActionSpec

_EDGES = (0, 1, 2, 32_767, 32_768, 32_769, 65_535, 65_536, 65_537, 524_287, 524_288, 1 << 31, (1 << 32) - 1)
_ZERO = 1 << 31
_STAGES = 8
_BITS = 4


def reciprocal(window_us: int) -> int:
    """What an entry has for windows of this length, µs."""
    return -(-(1 << 64) // window_us)


def entries(
    random: Random, tables: Mapping[str, Table], reciprocals: Sequence[int]
) -> Iterator[tuple[str, TableEntry]]:
    """Table and entry: up to four for each counting stage, for one of few queries or for every frame.

    reciprocals: of the windows that an entry may have
    """
    for stage in range(_STAGES):
        name = f"ingress.count_{stage}.queries"
        actions = [each for each in tables[name].spec.actions if each.params]
        for priority in range(1, random.randint(1, 5)):
            bit = 1 << random.randrange(_BITS)
            match = (random.choice([Ternary(bit, bit), Ternary(0, 0)]),)
            action = random.choice(actions)
            yield name, TableEntry(match, action.name, _params(random, action, reciprocals), priority)


def _params(random: Random, action: ActionSpec, reciprocals: Sequence[int]) -> tuple[int, ...]:
    anywhere, small = random.choice(_EDGES), random.choice([1, 2, 3, 8, 64])
    if random.random() < 0.2:
        anywhere = random.getrandbits(32)
    given = {
        "query": random.randrange(_BITS),
        "count_of": random.choice([0, 0, 1, 255]),
        "generation": random.randint(0, 1),
        "threshold": random.choice([0, 1, _ZERO, _ZERO + 2, random.getrandbits(32)]),
        "reciprocal": random.choice(reciprocals),
        "base": random.choice([0, 0, 50, anywhere]),
        "size": random.choice([small, small, random.choice(_EDGES), random.getrandbits(32)]),
    }
    chosen = {each.name: random.choice([0, (1 << each.width) - 1]) for each in action.params}
    return tuple({**chosen, **given}[each.name] for each in action.params)


def question(random: Random) -> dict[str, int]:
    """Fields of a packet-out: mostly a cell to read or a ring to sweep, else any operation there may be.

    Never as of now, since two switches do not agree about that.
    """
    return {
        "egress_port": random.randrange(5),
        "operation": random.choice([1, 1, 2, 2, 2, random.getrandbits(7)]),
        "query": random.choice([random.randrange(_BITS), random.randrange(256), random.getrandbits(32)]),
        "key_source": random.choice([0, 0x0A000000 + random.randint(1, 4), random.getrandbits(128)]),
        "key_destination": random.choice([0, 0x0A000000 + random.randint(1, 4), random.getrandbits(128)]),
        "key_port": random.choice([0, 80, random.getrandbits(16)]),
        "key_length": random.choice([0, 1, random.getrandbits(16)]),
        "key_source_port": random.choice([0, random.getrandbits(16)]),
        "timestamp": random.choice([1, random.getrandbits(16) + 1, random.randrange(1, 1 << 48)]),
    }
