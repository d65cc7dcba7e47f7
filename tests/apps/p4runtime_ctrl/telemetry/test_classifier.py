"""The classifier gives every packet exactly the requests it meets, before, after and during a change."""

import ipaddress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apps.p4runtime_ctrl.errors import EntryError, TelemetryError
from apps.p4runtime_ctrl.southbound.p4info import EXACT, LPM, RANGE, TERNARY
from apps.p4runtime_ctrl.southbound.values import number
from apps.p4runtime_ctrl.state.desired_state import DELETE, EntrySet, difference
from apps.p4runtime_ctrl.telemetry.classifier import Classifier, TelemetryRequest
from sdnator.testing.product_program import program

CLASSIFIER = Classifier(program())
ADDRESSES = ["10.0.0.1", "10.0.0.9", "10.1.0.1", "192.168.0.1", "2001:db8::1", "2001:db8:1::1"]
PREFIXES = ["10.0.0.0/8", "10.0.0.0/16", "10.0.0.1", "192.168.0.0/16", "2001:db8::/32", "::/0", "0.0.0.0/0"]

conditions = st.fixed_dictionaries(
    {},
    optional={
        "src": st.sampled_from(PREFIXES),
        "dst": st.sampled_from(PREFIXES),
        "protocol": st.sampled_from([6, 17]),
        "tcp_flags": st.sampled_from([2, [2, 0x17], [0x12, 0x17], [0, 4]]),
        "dport": st.sampled_from([23, [20, 30], [25, 80], [0, 1023], [80, 65535]]),
        "sport": st.sampled_from([53, [1024, 65535]]),
        "ingress_port": st.sampled_from([1, 2]),
        "vid": st.sampled_from([0, 7]),
    },
)
packets = st.fixed_dictionaries(
    {
        "src": st.sampled_from(ADDRESSES),
        "dst": st.sampled_from(ADDRESSES),
        "protocol": st.sampled_from([1, 6, 17]),
        "tcp_flags": st.sampled_from([0, 2, 0x12, 0xC2, 4]),
        "dport": st.sampled_from([0, 22, 23, 25, 30, 80, 65535]),
        "sport": st.sampled_from([0, 53, 1024, 40000]),
        "ingress_port": st.sampled_from([1, 2, 3]),
        "vid": st.sampled_from([0, 7]),
    }
)


@st.composite
def request_sets(draw):
    chosen = draw(st.dictionaries(st.integers(0, 5), conditions, max_size=5))
    return [TelemetryRequest(name=f"q{bit}", bit=bit, conditions=given) for bit, given in chosen.items()]


def holds(name, wanted, packet):
    """One condition of a request, evaluated the obvious way."""
    value = packet[name]
    if name in ("src", "dst"):
        network, address = ipaddress.ip_network(wanted), ipaddress.ip_address(value)
        return network.version == address.version and address in network
    if isinstance(wanted, list):
        if name == "tcp_flags":
            return value & wanted[1] == wanted[0]
        return wanted[0] <= value <= wanted[1]
    return value == wanted


def truth(requests, packet):
    met = [r.bit for r in requests if all(holds(name, c, packet) for name, c in r.conditions.items())]
    return sum(1 << bit for bit in met)


def field_value(name, packet):
    if name == "is_ipv4":
        return int("." in packet["src"])
    if name in ("src", "dst"):
        return int(ipaddress.ip_address(packet[name]))
    return packet.get(name, 0)


def matched(entry, table, packet):
    by_id = {field.id: field for field in table.fields}
    for match in entry.match:
        field = by_id[match.field_id]
        value = field_value(field.name, packet)
        if field.name == "is_ipv4":
            value = int("." in packet[table.fields[1].name])
        if field.kind == EXACT and value != number(match.exact.value):
            return False
        if field.kind == LPM and (value ^ number(match.lpm.value)) >> (field.width - match.lpm.prefix_len):
            return False
        if field.kind == TERNARY and (value & number(match.ternary.mask)) != number(match.ternary.value):
            return False
        if field.kind == RANGE and not number(match.range.low) <= value <= number(match.range.high):
            return False
    return True


def looked_up(entries, packet):
    """What the switch would find: one match a table, the longest prefix or the highest priority."""
    found = (1 << 256) - 1
    for table in (table for table in program().tables.values() if table.id in CLASSIFIER.table_ids):
        mine = [entry for entry in entries if entry.table_id == table.id]
        hits = [entry for entry in mine if not entry.is_default_action and matched(entry, table, packet)]
        default = next(entry for entry in mine if entry.is_default_action)
        best = max(hits, key=lambda e: (e.priority, sum(m.lpm.prefix_len for m in e.match)), default=default)
        found &= number(best.action.action.params[0].value)
    return found


@settings(max_examples=150, deadline=None)
@given(request_sets(), st.lists(packets, min_size=1, max_size=12))
def test_every_packet_meets_exactly_its_requests(requests, some):
    entries = list(CLASSIFIER.entries(requests))
    for packet in some:
        assert looked_up(entries, packet) == truth(requests, packet)


@settings(max_examples=80, deadline=None)
@given(request_sets(), request_sets(), st.lists(packets, min_size=1, max_size=6))
def test_no_packet_sees_half_a_request_during_a_change(before, after, some):
    kept = [request for request in after if request in before]
    state = EntrySet(CLASSIFIER.entries(before))
    changes = CLASSIFIER.transition(state, CLASSIFIER.entries(after), kept)
    for place, change in enumerate(changes, start=1):
        if change.kind == DELETE:
            assert state.discard(change.entry)
        else:
            state.put(change.entry)
        allowed = after if place == len(changes) else kept
        for packet in some:
            seen = looked_up(state, packet)
            assert seen & truth(kept, packet) == truth(kept, packet)
            if len(changes) > 1:
                assert seen & ~truth(allowed, packet) == 0
    assert difference(CLASSIFIER.entries(after), state) == []


def test_every_packet_is_one_bit_in_every_default_action():
    entries = list(CLASSIFIER.entries([TelemetryRequest(name="packets", bit=255)]))
    assert all(entry.is_default_action for entry in entries)
    assert len(entries) == len(CLASSIFIER.table_ids)
    assert {number(p.value) for e in entries for p in e.action.action.params if p.value} == {0, 1 << 255}


def test_a_request_comes_in_with_active_last_and_leaves_with_active_first():
    nothing = CLASSIFIER.entries([])
    request = TelemetryRequest(name="packets", bit=255)
    active = program().table("telemetry_active").id
    coming = CLASSIFIER.transition(nothing, CLASSIFIER.entries([request]), kept=[])
    assert [change.entry.table_id == active for change in coming] == [False] * (len(coming) - 1) + [True]
    going = CLASSIFIER.transition(CLASSIFIER.entries([request]), nothing, kept=[])
    assert [change.entry.table_id == active for change in going] == [True] + [False] * (len(going) - 1)


def test_counted_requests_are_active_but_not_copied():
    entries = CLASSIFIER.entries(
        [TelemetryRequest(name="a", bit=0, copy=False), TelemetryRequest(name="b", bit=1)]
    )
    active = next(e for e in entries if e.table_id == program().table("telemetry_active").id)
    maps = [number(param.value) for param in active.action.action.params]
    assert maps == [3, 2, 0]


def test_what_cannot_be_held_is_refused():
    with pytest.raises(TelemetryError, match="a and b share bit 4"):
        CLASSIFIER.entries([TelemetryRequest(name="a", bit=4), TelemetryRequest(name="b", bit=4)])
    with pytest.raises(TelemetryError, match=r"not within 0\.\.255"):
        CLASSIFIER.entries([TelemetryRequest(name="a", bit=256)])
    with pytest.raises(EntryError, match="no condition 'ttl'; there are dport"):
        CLASSIFIER.entries([TelemetryRequest(name="a", bit=1, conditions={"ttl": 1})])
    with pytest.raises(EntryError, match="needs is_ipv4"):
        CLASSIFIER.entries([TelemetryRequest(name="a", bit=1, conditions={"src": [0, 0]})])
    crossing = [
        TelemetryRequest(
            name=f"q{n}",
            bit=n,
            conditions={"protocol": [1 << n % 8, 1 << n % 8], "tcp_flags": [1 << n // 8, 1 << n // 8]},
        )
        for n in range(60)
    ]
    with pytest.raises(TelemetryError, match="telemetry_l4 has room for"):
        CLASSIFIER.entries(crossing)


def test_what_cannot_be_held_is_left_out_with_its_reason_and_the_rest_fits():
    good = [TelemetryRequest(name=f"q{bit}", bit=bit, conditions={"dport": bit}) for bit in range(3)]
    bad = [
        TelemetryRequest(name="far", bit=7, conditions={"ingress_port": CLASSIFIER.last_port + 1}),
        TelemetryRequest(name="twice", bit=1),
        TelemetryRequest(name="odd", bit=8, conditions={"colour": 1}),
    ]
    fit, left_out = CLASSIFIER.fitting([*good[:2], *bad, good[2]])
    assert fit == good
    assert list(left_out) == ["far", "twice", "odd"]
    assert "does not fit into 9 bits" in left_out["far"]
    assert CLASSIFIER.fitting(good) == (good, {})
