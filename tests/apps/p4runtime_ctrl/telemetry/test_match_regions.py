"""Match regions cover, meet and are ordered as sets of packets are; their closure has every intersection."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.p4runtime_ctrl.errors import EntryError, TelemetryError
from apps.p4runtime_ctrl.telemetry.match_regions import (
    Closure,
    Covering,
    MatchRegion,
    RangeMatch,
    Shape,
    TernaryMatch,
)
from sdnator.testing.product_program import program

VALUES = range(16)
bits = st.tuples(st.integers(0, 15), st.integers(0, 15)).map(
    lambda pair: TernaryMatch(pair[0] & pair[1], pair[1])
)
spans = st.tuples(st.integers(0, 15), st.integers(0, 15)).map(lambda p: RangeMatch(min(p), max(p), 4))
regions = st.tuples(bits, spans).map(MatchRegion)


def inside(region):
    """The naive set of the packets in a region."""
    first, second = region.sides
    return {
        (a, b)
        for a in VALUES
        for b in VALUES
        if a & first.mask == first.value and second.low <= b <= second.high
    }


@given(regions, regions)
def test_covering_and_meeting_are_those_of_sets(one, other):
    assert one.covers(other) == (inside(one) >= inside(other))
    met = one.meet(other)
    assert (inside(met) if met else set()) == inside(one) & inside(other)


@given(regions, regions)
def test_a_region_inside_another_is_narrower(one, other):
    if inside(one) < inside(other):
        assert sum(s.narrowness() for s in one.sides) > sum(s.narrowness() for s in other.sides)


@given(st.lists(regions, max_size=5), st.integers(0, 5))
def test_the_closure_holds_every_intersection_however_it_came_about(some, first):
    growing = Closure(limit=10_000, where="here")
    growing.of(some[:first])
    found = growing.of(some)
    assert set(Closure(limit=10_000, where="here").of(some)) == set(found)
    assert growing.of(some[first:]) is not None
    assert set(growing.of(some)) == set(found)
    sets = {frozenset(inside(region)) for region in found}
    assert all(not (a & b) or a & b in sets for a in sets for b in sets)
    assert all(frozenset(inside(region)) in sets for region in some)
    assert len(found) == len(set(found))


@given(st.lists(regions, max_size=8, unique=True), regions)
def test_covering_finds_the_same_as_looking_at_each(some, region):
    bits = {each: 1 << place for place, each in enumerate(some)}
    naive = sum(bit for each, bit in bits.items() if each.covers(region))
    assert Covering(bits).bits(region) == naive


def test_a_table_that_is_too_small_is_named():
    with pytest.raises(TelemetryError, match="here has room for 2 conditions"):
        Closure(limit=2, where="here").of([MatchRegion((TernaryMatch(0, 1 << n),)) for n in range(3)])


def test_shapes_speak_the_notation_of_table_updates():
    shape = Shape(program().table("telemetry_src"))
    for given_match, match in (
        ({"src": "10.0.0.0/8"}, {"is_ipv4": 1, "src": [0x0A000000, 104]}),
        ({"src": "2001:db8::/32"}, {"is_ipv4": 0, "src": [0x20010DB8 << 96, 32]}),
        ({"src": ["10.0.0.1", 32]}, {"is_ipv4": 1, "src": [0x0A000001, 128]}),
        ({"is_ipv4": 1}, {"is_ipv4": 1, "src": [0, 0]}),
    ):
        assert shape.match(shape.region(given_match)) == match
    ports = Shape(program().table("telemetry_dport"))
    assert ports.match(ports.region({"dport": 80})) == {"dport": [80, 80]}
    with pytest.raises(EntryError, match=r"range 9\.\.3 is empty"):
        ports.region({"dport": [9, 3]})
