"""Selections and stretches of packets against plain indexing."""

import random

import numpy as np
import pytest

from apps.sonata_adapter.columns import Packets
from apps.sonata_adapter.evaluation import column_of
from apps.sonata_adapter.expressions import Field
from apps.sonata_adapter.query import ip, tcp, udp
from tests.apps.sonata_adapter.traffic import batch_of, mixed

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
    plain = Packets(batch.take(rows))
    assert packets.origin.tolist() == rows.tolist()
    assert packets.keys(VALUES).tolist() == plain.keys(VALUES).tolist()
    assert columns(packets) == columns(plain)
    some = np.arange(0, len(rows), 3)
    assert packets.keys_at(VALUES, some).tolist() == plain.keys(VALUES)[some].tolist()
    taken = [np.asarray(part).tolist() for column in packets.columns_at(VALUES, some) for part in column]
    assert taken == columns(Packets(batch.take(rows[some])))


@pytest.mark.parametrize("asked_before", [False, True])
@pytest.mark.parametrize("condition", [TCP, DNS, ip.version == 6])
def test_parts_of_a_batch_have_their_rows_fields(batch, condition, asked_before):
    """Selections, stretches, selections of stretches and stretches of selections."""
    packets = Packets(batch)
    if asked_before:
        packets.keys(VALUES)
    chosen = Packets(batch).where(condition.node).origin
    first, end = len(batch) // 3, len(batch) // 2
    inside = chosen[(chosen >= first) & (chosen < end)]
    same(packets.where(condition.node), batch, chosen)
    same(packets.between(first, end).where(condition.node), batch, inside)
    same(packets.where(condition.node).between(first, end), batch, inside)
    same(packets.between(first, end), batch, np.arange(first, end))
    same(packets.between(first, end).at(np.arange(5, 90, 7)), batch, np.arange(first, end)[5:90:7])
    assert not len(packets.where(condition.node).between(end, end).where(TCP.node))


def test_flows_are_the_same_in_all_parts(batch):
    """Two packets share their flow's bits when they share addresses, protocol and ports, and never else."""
    rows = np.array(random.Random(1).sample(range(len(batch)), 400))
    names = ("ip_src_lo", "ip_dst_lo", "ip_src_hi", "ip_dst_hi", "ip_proto")
    names += ("tcp_sport", "tcp_dport", "udp_sport", "udp_dport")
    flows = [tuple(int(batch[name][row]) for name in names) for row in rows.tolist()]
    bits = Packets(batch).flows()[rows].tolist()
    assert len(set(zip(flows, bits, strict=True))) == len(set(flows)) == len(set(bits))
    assert Packets(batch).between(100, 300).flows().tolist() == Packets(batch).flows()[100:300].tolist()
