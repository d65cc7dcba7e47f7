"""Entries: what is refused and why, what wins, and what each entry keeps; on both back ends."""

from dataclasses import replace
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataplane.errors import DataplaneError
from dataplane.v1model.externs import CounterValue, MeterConfig
from dataplane.v1model.switch import Switch
from dataplane.v1model.tables import (
    AlreadyExists,
    Exact,
    InvalidEntry,
    Lpm,
    Match,
    NotFound,
    Optional,
    Range,
    TableEntry,
    TableFull,
    Ternary,
)
from sdnator.testing.switch_traffic import frame
from tests.dataplane.loading import MAKERS, features, fields
from tests.naive.matching import Naive


@pytest.fixture(params=MAKERS)
def switch(request):
    made = Switch(features(), maker=request.param)
    yield made
    made.close()


def flow(low: int, high: int, value: int, mask: int, a: int) -> Match:
    return (Range(low, high), Ternary(value, mask), Exact(a))


PORT = TableEntry((Exact(1),), "I.forward", (2,))


def test_insert_twice_and_miss(switch):
    ports = switch.tables["I.ports"]
    ports.insert(PORT)
    with pytest.raises(AlreadyExists, match=r"I\.ports already has an entry for \(sm.ingress_port=Exact"):
        ports.insert(TableEntry((Exact(1),), "NoAction"))
    with pytest.raises(NotFound, match=r"I\.ports has no entry"):
        ports.delete((Exact(2),))
    with pytest.raises(NotFound):
        ports.modify(TableEntry((Exact(2),), "NoAction"))
    assert ports.get((Exact(2),)) is None
    assert ports.entries() == [PORT]


def test_size_is_the_programs(switch):
    ports = switch.tables["I.ports"]
    for n in range(16):
        ports.insert(TableEntry((Exact(n),), "NoAction"))
    with pytest.raises(TableFull, match="its size in the program is 16"):
        ports.insert(TableEntry((Exact(16),), "NoAction"))
    ports.delete((Exact(3),))
    ports.insert(TableEntry((Exact(16),), "NoAction"))
    ports.clear()
    assert len(ports) == 0


@pytest.mark.parametrize(
    ("table", "entry", "text"),
    [
        ("I.ports", TableEntry((Exact(512),), "NoAction"), "does not fit 9 bits"),
        ("I.ports", TableEntry((Exact(1), Exact(2)), "NoAction"), "1 key fields, got 2"),
        ("I.ports", TableEntry((Ternary(1, 1),), "NoAction"), "is matched exact"),
        ("I.ports", TableEntry((Range(1, 2),), "NoAction"), "is matched exact"),
        ("I.ports", TableEntry((Exact(1),), "I.counted", (1,)), "has no action I.counted"),
        ("I.ports", TableEntry((Exact(1),), "I.forward"), "takes 1 parameters, got 0"),
        ("I.ports", TableEntry((Exact(1),), "I.forward", (512,)), "port=512 does not fit 9 bits"),
        ("I.ports", TableEntry((Exact(1),), "NoAction", (), 1), "takes no priority"),
        ("I.ports", TableEntry((Exact(1),), "NoAction", idle_timeout_ns=1), "no idle time-outs"),
        ("I.route", TableEntry((Lpm(1, 8),), "I.drop"), "outside its mask"),
        ("I.route", TableEntry((Lpm(1, 33),), "I.drop"), "prefix length 33"),
        ("I.route", TableEntry((Lpm(0, 1),), "I.drop", idle_timeout_ns=-1), "idle time-out of -1"),
        ("I.flows", TableEntry(flow(0, 1, 1, 1, 1), "I.drop"), "priority of at least 1"),
        ("I.flows", TableEntry(flow(0, 1, 1, 1, 1), "I.drop", (), 1 << 31), "31 bits"),
        ("I.flows", TableEntry(flow(2, 1, 1, 1, 1), "I.drop", (), 1), "not within 0..65535"),
        ("I.flows", TableEntry(flow(0, 1, 3, 1, 1), "I.drop", (), 1), "outside its mask"),
        ("I.fixed", TableEntry((Exact(1), Ternary(0, 0)), "I.drop", (), 1), "constant entries"),
    ],
)
def test_what_does_not_fit_is_refused(switch, table, entry, text):
    with pytest.raises(InvalidEntry, match=text):
        switch.tables[table].insert(entry)
    assert switch.tables[table].get(entry.match, entry.priority) is None


def test_defaults(switch):
    ports, fixed = switch.tables["I.ports"], switch.tables["I.fixed"]
    assert ports.default == ("NoAction", ())
    ports.set_default("I.forward", (3,))
    assert switch.process(1, frame(0), 0).outputs[0][0] == 3
    ports.reset_default()
    assert switch.process(1, frame(0), 0).outputs[0][0] == 0
    with pytest.raises(InvalidEntry):
        ports.set_default("I.forward", ())
    assert [e.priority for e in fixed.entries()] == sorted(
        (e.priority for e in fixed.entries()), reverse=True
    )
    with pytest.raises(InvalidEntry, match="constant entries"):
        fixed.delete((Exact(2), Ternary(5, 0xFF)), fixed.entries()[-1].priority)


def test_modify_keeps_counter_and_can_change_the_action(switch):
    route = switch.tables["I.route"]
    key = (Lpm(0, 0),)
    route.insert(TableEntry(key, "I.drop", metadata=b"who"))
    assert route.get(key) == TableEntry(key, "I.drop", metadata=b"who")
    route.set_counter(key, 0, CounterValue(5, 500))
    route.modify(TableEntry(key, "NoAction"))
    assert route.counter(key) == CounterValue(5, 500)
    route.delete(key)
    route.insert(TableEntry(key, "I.drop"))
    assert route.counter(key) == CounterValue(), "a new entry in an old place starts at zero"
    with pytest.raises(InvalidEntry, match="no direct counter"):
        switch.tables["I.ports"].set_counter((Exact(1),), 0, CounterValue())


def test_direct_meter_configuration(switch):
    flows = switch.tables["I.flows"]
    entry = TableEntry(flow(0, 1, 0, 0, 1), "I.drop", (), 1)
    flows.insert(entry)
    assert flows.meter(entry.match, 1) is None
    flows.set_meter(entry.match, 1, MeterConfig(1, 2, 3, 4))
    assert flows.meter(entry.match, 1) == MeterConfig(1, 2, 3, 4)
    flows.set_meter(entry.match, 1, None)
    assert flows.meter(entry.match, 1) is None
    with pytest.raises(DataplaneError, match="cir must not exceed pir"):
        flows.set_meter(entry.match, 1, MeterConfig(5, 2, 3, 4))
    with pytest.raises(InvalidEntry, match="no direct meter"):
        switch.tables["I.route"].set_meter((Lpm(0, 0),), 0, None)


def test_idle_timeout_on_the_packets_clock(switch):
    route = switch.tables["I.route"]
    entry = TableEntry((Lpm(0, 0),), "I.drop", idle_timeout_ns=5_000_000)
    switch.process(1, b"", 1000)
    route.insert(entry)
    assert switch.expired(5999) == []
    assert switch.expired(6000) == [(route, entry)]
    assert switch.expired(10_999) == [], "reported once"
    assert switch.expired(11_000) == [(route, entry)], "and again after another time-out"
    switch.process(1, bytes(12) + b"\x08\0" + b"\x45" + bytes(19), 12_000)
    assert route.idle_ns(entry.match, 0, 13_000) == 1_000_000
    assert switch.expired(16_999) == []
    assert switch.expired(17_000) == [(route, entry)]
    route.modify(TableEntry((Lpm(0, 0),), "I.drop"))
    assert switch.expired(10**9) == []


keys = st.one_of(
    st.tuples(
        st.tuples(st.integers(0, 40), st.integers(0, 40)).map(lambda p: Range(min(p), max(p))),
        st.tuples(st.integers(0, 15), st.sampled_from([0, 1, 3, 8, 15, 2**32 - 1])).map(
            lambda p: Ternary(p[0] & p[1], p[1])
        ),
        st.integers(0, 2).map(Exact),
    )
)


@settings(max_examples=60, deadline=None)
@given(
    entries=st.lists(st.tuples(keys, st.integers(1, 6)), max_size=30),
    removed=st.sets(st.integers(0, 29), max_size=15),
    asked=st.lists(st.tuples(st.integers(0, 40), st.integers(0, 15), st.integers(0, 2)), max_size=20),
)
@pytest.mark.parametrize("maker", MAKERS)
def test_lookup_equals_a_list_read_from_the_top(maker, entries, removed, asked):
    """Tuple-space search against the obvious: every entry tried, best priority first, then the oldest slot."""
    switch = Switch(features(), maker=maker)
    switch.tables["I.ports"].set_default("I.forward", (2,))
    table, naive = switch.tables["I.flows"], Naive()
    known: list[tuple[Match, int]] = []
    for n, (match, priority) in enumerate(entries):
        entry = TableEntry(match, "I.metered", (n,), priority)
        if (match, priority) not in known:
            known.append((match, priority))
            table.insert(entry)
            naive.insert(entry)
    for n in sorted(removed):
        if n < len(known):
            table.delete(*known[n])
            naive.delete(*known[n])
    for c, d, a in asked:
        found = naive.find((c, d, a))
        result = switch.process(1, frame(6, a=a, c=c, d=d), 0)
        port, data = result.outputs[0]
        assert port == (2 if found is None else found.params[0])
        assert (fields(data)["b"] == 0xEE) == (found is None)
    switch.close()


@pytest.mark.parametrize("maker", MAKERS)
def test_many_entries_stay_findable_through_growth_and_removal(maker):
    switch = Switch(features(), maker=maker)
    route = switch.tables["I.route"]
    for n in range(64):
        route.insert(TableEntry((Lpm(n << 8, 24),), "I.counted", (n,)))
    for n in range(0, 64, 2):
        route.delete((Lpm(n << 8, 24),))
    for n in range(64):
        data = bytes(12) + b"\x08\0\x45" + bytes(15) + (n << 8).to_bytes(4, "big")
        ports = [p for p, _ in switch.process(1, data, 0).outputs]
        assert ports == ([n] if n % 2 else [])
    switch.close()


@pytest.mark.parametrize("maker", MAKERS)
def test_hundreds_of_masks_find_what_a_list_finds(maker):
    """More groups than a word of the sieve has bits, while entries come and go."""
    program = features()
    wide = replace(program.tables["I.flows"], size=512)
    switch = Switch(replace(program, tables={**program.tables, "I.flows": wide}), maker=maker)
    switch.tables["I.ports"].set_default("I.forward", (2,))
    table, naive, random = switch.tables["I.flows"], Naive(), Random(4)
    known: list[TableEntry] = []
    for n in range(700):
        if known and random.random() < (0.1 if n < 400 else 0.8):
            gone = known.pop(random.randrange(len(known)))
            table.delete(gone.match, gone.priority)
            naive.delete(gone.match, gone.priority)
            continue
        mask = random.getrandbits(32) & random.choice([0x0F, 0xFF00, 0xFFFF0000, 0xF0F0F0F0, 2**32 - 1])
        match = (Range(0, random.choice([50, 65535])), Ternary(random.getrandbits(32) & mask, mask), Exact(1))
        entry = TableEntry(match, "I.metered", (n % 500,), 1000 - n)
        known.append(entry)
        table.insert(entry)
        naive.insert(entry)
        value, c = random.choice(known).match[1].value | random.getrandbits(4), random.randint(0, 100)
        found = naive.find((c, value, 1))
        port = switch.process(1, frame(6, a=1, c=c, d=value), 0).outputs[0][0]
        assert port == (2 if found is None else found.params[0])
    switch.close()


def test_a_taken_entry_comes_back_with_counter_and_meter(switch):
    route, flows = switch.tables["I.route"], switch.tables["I.flows"]
    routed = TableEntry((Lpm(0, 0),), "I.drop", idle_timeout_ns=5_000_000, metadata=b"who")
    metered = TableEntry(flow(0, 1, 0, 0, 1), "I.drop", (), 1)
    route.insert(routed)
    flows.insert(metered)
    route.set_counter(routed.match, 0, CounterValue(5, 500))
    flows.set_meter(metered.match, 1, MeterConfig(1, 2, 3, 4))
    undo = [route.take(routed.match), flows.take(metered.match, 1)]
    assert (len(route), len(flows), switch.expired(10**9)) == (0, 0, [])
    for put_back in undo:
        put_back()
    assert route.entries() == [routed]
    assert route.counter(routed.match) == CounterValue(5, 500)
    assert flows.meter(metered.match, 1) == MeterConfig(1, 2, 3, 4)
    assert switch.expired(10**9) == [(route, routed)]


def test_a_packed_key_is_the_key(switch):
    ports = switch.tables["I.ports"]
    ports.insert_packed(ports.key.packed(PORT.match, 0), PORT.action, PORT.params, 0, b"")
    assert ports.get(PORT.match) == PORT
    with pytest.raises(AlreadyExists):
        ports.insert(PORT)
    ports.delete(ports.key.packed(PORT.match, 0))
    assert ports.entries() == []


def test_optional_values():
    """p4c compiles `optional` into ternary; a table of the kind itself is matched as whole or not at all."""
    naive = Naive()
    naive.insert(TableEntry((Optional(None),), "any", (), 1))
    naive.insert(TableEntry((Optional(5),), "five", (), 2))
    found = [naive.find((5,)), naive.find((6,))]
    assert [entry.action for entry in found if entry] == ["five", "any"]
