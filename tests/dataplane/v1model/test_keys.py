"""Keys of tables: packed and back, and what the back ends are told."""

import pytest

from dataplane.errors import InvalidEntry
from dataplane.v1model.keys import Exact, Lpm, TableKey, Ternary
from dataplane.v1model.tree import KeySpec, MatchKind, TableSpec


def key(*kinds: MatchKind) -> TableKey:
    specs = tuple(KeySpec(f"k{n}", kind, 8 * (n + 1)) for n, kind in enumerate(kinds))
    return TableKey(TableSpec("t", specs, (), 10), (64, 0)[: len(kinds)])


def test_exact_fields_pack_into_one_number_and_come_back():
    pair = key(MatchKind.EXACT, MatchKind.EXACT)
    packed = pair.packed((Exact(0xAB), Exact(0x1234)), 0)
    assert (pair.all_exact, packed) == (True, 0xAB << 64 | 0x1234)
    assert pair.unpacked(packed) == (Exact(0xAB), Exact(0x1234))


@pytest.mark.parametrize(
    ("match", "priority", "text"),
    [
        ((Exact(1),), 0, "2 key fields, got 1"),
        ((Exact(1), Exact(2)), 3, "takes no priority"),
        ((Exact(256), Exact(2)), 0, "does not fit 8 bits"),
        ((Exact(1), Ternary(1, 1)), 0, "is matched exact"),
    ],
)
def test_what_cannot_be_packed_is_refused(match, priority, text):
    with pytest.raises(InvalidEntry, match=text):
        key(MatchKind.EXACT, MatchKind.EXACT).packed(match, priority)


def test_a_prefix_ranks_by_its_length_unless_there_are_priorities():
    assert key(MatchKind.LPM).rule((Lpm(0xA0, 4),), 0) == (0xA0 << 64, 0xF0 << 64, (), 4)
    both = key(MatchKind.LPM, MatchKind.TERNARY)
    assert both.rule((Lpm(0xA0, 4), Ternary(1, 1)), 7) == (0xA0 << 64 | 1, 0xF0 << 64 | 1, (), 7)
