"""The short way to an exact key gives what the long one gives, or leaves the message to it."""

import pytest

from dataplane.p4runtime.schema import BoundTable
from dataplane.p4runtime.table_codec import TableCodec, packed_reader
from dataplane.v1model.keys import TableKey
from dataplane.v1model.tree import KeySpec, MatchKind, TableSpec
from p4rt import p4runtime

SPEC = TableSpec("t", (KeySpec("a", MatchKind.EXACT, 4), KeySpec("b", MatchKind.EXACT, 32)), (), 10)
BOUND = BoundTable(7, SPEC, (1, 2), (MatchKind.EXACT, MatchKind.EXACT), (), const_default=False)
KEY = TableKey(SPEC, (64, 0))


def fields(*values: tuple[int, bytes]):
    entry = p4runtime.TableEntry()
    for field_id, value in values:
        entry.match.add(field_id=field_id).exact.value = value
    return entry.match


@pytest.mark.parametrize("a", [b"\0", b"\x0f", b"\0\x05"])
@pytest.mark.parametrize("b", [b"\0", b"\xff\xff\xff\xff"])
def test_short_and_long_way_agree(a, b):
    match = fields((1, a), (2, b))
    packed = packed_reader(BOUND, KEY)(match)
    assert packed is not None
    assert KEY.unpacked(packed) == TableCodec(BOUND).match(match)


@pytest.mark.parametrize(
    "match",
    [
        fields((2, b"\1"), (1, b"\1")),
        fields((1, b"\1")),
        fields((1, b"\1"), (2, b"\1"), (2, b"\1")),
        fields((1, b"\x10"), (2, b"\1")),
        fields((1, b"\1"), (2, b"")),
    ],
    ids=["another order", "one left out", "one twice", "too wide", "empty"],
)
def test_anything_unusual_takes_the_long_way(match):
    assert packed_reader(BOUND, KEY)(match) is None


def test_a_field_of_another_kind_takes_the_long_way():
    match = fields((1, b"\1"), (2, b"\1"))
    match[1].ternary.value = b"\1"
    assert packed_reader(BOUND, KEY)(match) is None
