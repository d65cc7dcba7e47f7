"""What comes to a victim of one kind, comes at a rate: the rest is dropped and counted; other packets pass."""

import pytest

from dataplane.v1model.externs import MeterConfig
from dataplane.v1model.tables import Exact, Ternary
from tests.p4.sdnator_switch import entry, ethernet, mac, want_all

ENDS = (mac(1), mac(2))
VICTIM = bytes([10, 0, 0, 2])
RESOLVER = bytes([10, 0, 0, 9])
SECOND = 1_000_000
SLOT = 3
ANY = Ternary(0, 0)
LATER = 0x2000 | 5


def ipv4(protocol, rest, *, source=bytes([10, 0, 0, 1]), destination=VICTIM, fragment=0):
    head = bytes([0x45, 0]) + (20 + len(rest)).to_bytes(2, "big") + b"\0\1" + fragment.to_bytes(2, "big")
    return ethernet(*ENDS, head + bytes([64, protocol, 0, 0]) + source + destination + rest)


def answer(source=bytes([10, 0, 0, 1]), *, port=53, destination=VICTIM):
    ports = port.to_bytes(2, "big") + (4_000).to_bytes(2, "big")
    return ipv4(17, ports + b"\0\x08\0\0", source=source, destination=destination)


def segment(flags, port=443):
    ports = (4_000).to_bytes(2, "big") + port.to_bytes(2, "big")
    return ipv4(6, ports + bytes(8) + bytes([0x50, flags]) + bytes(6))


def ping(kind=8):
    return ipv4(1, bytes([kind, 0]) + bytes(6))


def limit(switch, rate, *, protocol=17, sport=ANY, dport=ANY, flags=ANY, icmp=ANY, fragment=ANY, priority=9):
    match = (
        Ternary(1, 1), Ternary(int.from_bytes(VICTIM, "big"), (1 << 128) - 1), Ternary(protocol, 0xFF),
        sport, dport, flags, icmp, fragment,
    )  # fmt: skip
    over = switch.tables["ingress.limit_over"]
    if not over.entries():
        over.insert(entry((Exact(SLOT),), "drop_over"))
    table = switch.tables["ingress.limit"]
    table.insert(entry(match, "limit_rate", SLOT, priority=priority))
    table.set_meter(match, priority, MeterConfig(rate, rate, rate, rate))
    return match


@pytest.fixture
def forwarding(switch):
    switch.tables["ingress.forward_port"].insert(entry((Exact(1),), "to_port", 2))
    return switch


def passed(switch, data, times):
    return sum(bool(switch.process(1, data, at).outputs) for at in times)


def dropped(switch):
    return switch.tables["ingress.limit_over"].counter((Exact(SLOT),)).packets


DNS = Ternary(53, 0xFFFF)


def test_the_rate_passes_and_the_rest_is_dropped_and_counted(forwarding):
    """A second's worth at once, then as much a second; what was dropped is never copied."""
    match = limit(forwarding, 10, sport=DNS)
    want_all(forwarding, copies=1)
    first = [forwarding.process(1, answer(), 10 * SECOND) for _ in range(50)]
    assert [bool(each.outputs) for each in first] == [True] * 10 + [False] * 40
    assert [bool(each.packet_ins) for each in first] == [True] * 10 + [False] * 40
    steady = [10 * SECOND + 10_000 * n for n in range(1, 401)]  # 100 a second, for 4 s
    assert passed(forwarding, answer(), steady) == 40
    assert dropped(forwarding) == 40 + 360
    assert forwarding.tables["ingress.limit"].counter(match, 9).packets == 450


@pytest.mark.parametrize(
    "other",
    [
        answer(port=123),
        answer(destination=RESOLVER),
        segment(0x10, 53),
        ping(),
        ethernet(*ENDS, bytes(46), etype=0x0806),
    ],
    ids=["another port", "another host", "TCP", "ICMP", "ARP"],
)
def test_other_packets_are_untouched(forwarding, other):
    limit(forwarding, 1, sport=DNS)
    passed(forwarding, answer(), [SECOND] * 9)
    assert passed(forwarding, other, [SECOND] * 50) == 50


def test_acks_are_limited_and_syns_are_not(forwarding):
    limit(forwarding, 5, protocol=6, dport=Ternary(443, 0xFFFF), flags=Ternary(0, 0x02))
    assert passed(forwarding, segment(0x10), [SECOND] * 50) == 5
    assert passed(forwarding, segment(0x02), [SECOND] * 50) == 50
    assert passed(forwarding, segment(0x10, 80), [SECOND] * 50) == 50


def test_pings_are_limited_and_their_answers_are_not(forwarding):
    limit(forwarding, 5, protocol=1, icmp=Ternary(8, 0xFF))
    assert passed(forwarding, ping(), [SECOND] * 50) == 5
    assert passed(forwarding, ping(0), [SECOND] * 50) == 50


def test_later_fragments_share_the_slot(forwarding):
    limit(forwarding, 5, sport=DNS)
    limit(forwarding, 5, fragment=Ternary(2, 3), priority=4)
    later = ipv4(17, bytes(8), fragment=LATER)
    assert passed(forwarding, later, [SECOND] * 50) == 5
    assert dropped(forwarding) == 45


def test_a_spared_source_has_a_rate_of_its_own_beyond_the_limit(forwarding):
    limit(forwarding, 5, sport=DNS)
    spared = (Exact(SLOT), Exact(1), Exact(int.from_bytes(RESOLVER, "big")))
    table = forwarding.tables["ingress.limit_spared"]
    table.insert(entry(spared, "spare_source"))
    table.set_meter(spared, 0, MeterConfig(20, 20, 20, 20))
    assert passed(forwarding, answer(), [SECOND] * 50) == 5
    assert passed(forwarding, answer(RESOLVER), [SECOND] * 50) == 20
    assert dropped(forwarding) == 45 + 30


def test_who_is_allowed_is_not_limited_and_who_is_blocked_takes_no_part_of_the_rate(forwarding):
    limit(forwarding, 5, sport=DNS)
    blocked = (Exact(1), Exact(int.from_bytes(bytes([10, 0, 0, 1]), "big")))
    forwarding.tables["ingress.block_src"].insert(entry(blocked, "drop_src"))
    assert passed(forwarding, answer(), [SECOND] * 50) == 0
    assert dropped(forwarding) == 0
    allowed = (
        ANY,
        ANY,
        Ternary(1, 1),
        Ternary(int.from_bytes(RESOLVER, "big"), (1 << 128) - 1),
        ANY,
        ANY,
        ANY,
    )
    forwarding.tables["ingress.allow"].insert(entry(allowed, "allow_frame", priority=1))
    assert passed(forwarding, answer(RESOLVER), [SECOND] * 50) == 50
    assert passed(forwarding, answer(bytes([10, 0, 0, 7])), [SECOND] * 50) == 5


def test_without_its_last_part_a_limit_drops_nothing(forwarding):
    """`limit_over` is written first and removed last; in between nothing may be dropped uncounted."""
    limit(forwarding, 5, sport=DNS)
    forwarding.tables["ingress.limit_over"].delete((Exact(SLOT),))
    assert passed(forwarding, answer(), [SECOND] * 50) == 50
