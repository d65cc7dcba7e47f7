"""Selections and stretches of packets against plain indexing."""

import random
import weakref

import numpy as np
import pytest

from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.host.evaluation import FUNCTIONS, column_of, evaluate
from apps.sonata_adapter.query.expressions import COMPARISONS, BinaryOperation, Field, Number
from apps.sonata_adapter.query.language import field, icmp, ip, length, tcp, udp
from sdnator.testing.query_traffic import batch_of, mixed

VALUES = tuple(map(Field, ("ip.dst", "ip.src", "tcp.dport", "length", "dns.name")))
TCP = tcp.dport >= 0
DNS = udp.sport == 53


@pytest.fixture(scope="module")
def batch():
    return batch_of(mixed(["dns_tunnel", "new_tcp"], seconds=6))


def columns(packets):
    return [np.asarray(part).tolist() for value in VALUES for part in column_of(value, packets)]


def same(packets, batch, rows):
    """Fields and keys are those of the rows, and so are those of some of them."""
    plain = PacketColumns(batch.take(rows))
    assert packets.origin.tolist() == rows.tolist()
    assert packets.keys(VALUES).tolist() == plain.keys(VALUES).tolist()
    assert columns(packets) == columns(plain)
    some = np.arange(0, len(rows), 3)
    assert packets.keys_at(VALUES, some).tolist() == plain.keys(VALUES)[some].tolist()
    taken = [np.asarray(part).tolist() for column in packets.columns_at(VALUES, some) for part in column]
    assert taken == columns(PacketColumns(batch.take(rows[some])))


@pytest.mark.parametrize("asked_before", [False, True])
@pytest.mark.parametrize("condition", [TCP, DNS, ip.version == 6])
def test_parts_of_a_batch_have_their_rows_fields(batch, condition, asked_before):
    """Selections, stretches, selections of stretches and stretches of selections."""
    packets = PacketColumns(batch)
    if asked_before:
        packets.keys(VALUES)
    chosen = PacketColumns(batch).where(condition.node).origin
    first, end = len(batch) // 3, len(batch) // 2
    inside = chosen[(chosen >= first) & (chosen < end)]
    same(packets.where(condition.node), batch, chosen)
    same(packets.between(first, end).where(condition.node), batch, inside)
    same(packets.where(condition.node).between(first, end), batch, inside)
    same(packets.between(first, end), batch, np.arange(first, end))
    same(packets.between(first, end).at(np.arange(5, 90, 7)), batch, np.arange(first, end)[5:90:7])
    assert not len(packets.where(condition.node).between(end, end).where(TCP.node))


@pytest.mark.parametrize("asked_before", [False, True])
def test_numbers_stand_for_values_in_all_parts(batch, asked_before):
    """Whether all packets were numbered before or some only, and in tuples that an operator made."""
    packets, value = PacketColumns(batch), Field("ip.dst")
    if asked_before:
        packets.numbered(value)
    chosen = packets.where(TCP.node)
    tuples = chosen.tuples({"to": value}, np.arange(0, len(chosen), 5))
    few, stretch = packets.where(DNS.node), packets.between(50, 700)
    parts = [(tuples, Field("to")), (few, value), (chosen, value), (stretch, value), (packets, value)]
    for part, asked in parts:
        numbered = part.numbered(asked)
        high, low = numbered.known.columns()[0]
        expected = PacketColumns(batch).columns_at((value,), part.origin)[0]
        assert high[numbered.numbers].tolist() == np.asarray(expected[0]).tolist()
        assert low[numbered.numbers].tolist() == expected[1].tolist()


@pytest.mark.parametrize("field", [tcp.dport, udp.sport, tcp.flags, length, field("ip.version"), icmp.type])
@pytest.mark.parametrize("number", [-2, -1, 0, 16, 53, 300, 70_000])
def test_comparisons_as_fields_stand_equal_those_of_numbers(batch, field, number):
    """Of a field and of some of its bits, beyond what the field can hold too."""
    packets = PacketColumns(batch)
    values = packets.column(field.node.name)[0]
    for operator, same in FUNCTIONS.items():
        if operator not in COMPARISONS:
            continue
        plain = BinaryOperation(operator, field.node, Number(number))
        assert evaluate(plain, packets).tolist() == same(values, number).tolist()
        for mask in (23, 1 << 20):
            some = BinaryOperation(operator, BinaryOperation("&", field.node, Number(mask)), Number(number))
            assert evaluate(some, packets).tolist() == same(values & mask, number).tolist()


def test_packets_go_when_nobody_has_them(batch):
    """Also those that selections were taken from, without a look for cycles."""
    packets = PacketColumns(batch)
    packets.where(TCP.node).where((tcp.dport < 1024).node)
    packets.where((length > 0).node)
    packets.forget()
    gone = weakref.ref(packets)
    del packets
    assert gone() is None


def test_flows_are_the_same_in_all_parts(batch):
    """Two packets share their flow's bits when they share addresses, protocol and ports, and never else."""
    rows = np.array(random.Random(1).sample(range(len(batch)), 400))
    names = ("ip_src_lo", "ip_dst_lo", "ip_src_hi", "ip_dst_hi", "ip_proto")
    names += ("tcp_sport", "tcp_dport", "udp_sport", "udp_dport")
    flows = [tuple(int(batch[name][row]) for name in names) for row in rows.tolist()]
    bits = PacketColumns(batch).flows()[rows].tolist()
    assert len(set(zip(flows, bits, strict=True))) == len(set(flows)) == len(set(bits))
    assert (
        PacketColumns(batch).between(100, 300).flows().tolist()
        == PacketColumns(batch).flows()[100:300].tolist()
    )
