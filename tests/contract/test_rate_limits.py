"""The product's program on every target: a rate limit passes what its meters find green, and counts what it drops.

The meters here have bursts and no rate, so that no clock matters: BMv2's is the wall's.
"""

import pytest

from p4rt import p4runtime
from sdnator.testing.p4runtime_client import EntryBuilder, insert, modify, program_config
from sdnator.testing.product_program import PROGRAM

VICTIM, RESOLVER = 0x0A000002, 0x0A000009
ADDRESS = (1 << 128) - 1
SLOT = 3
_ETHERNET = bytes(12) + b"\x08\0"


def frame(number, *, source=0x0A000001, target=VICTIM, port=53):
    """A datagram; its number makes it different from others."""
    head = bytes.fromhex("4500001c") + number.to_bytes(2, "big") + bytes.fromhex("000040110000")
    ends = source.to_bytes(4, "big") + target.to_bytes(4, "big")
    return _ETHERNET + head + ends + port.to_bytes(2, "big") + bytes.fromhex("003500080000")


def metered(entity, burst):
    config = entity.table_entry.meter_config
    config.cir = config.pir = 0
    config.cburst = config.pburst = burst
    return entity


@pytest.fixture
def limited(target, bare):
    """A primary on a switch that lets five answers through to the victim, and two more of its name server."""
    target.drain()
    config = program_config(PROGRAM.with_suffix(""))
    bare.set_pipeline(config)
    names = EntryBuilder(config.p4info)
    match = {"is_ipv4": (1, 1), "dst": (VICTIM, ADDRESS), "protocol": (17, 0xFF), "sport": (53, 0xFFFF)}
    over = names.entry("ingress.limit_over", {"slot": SLOT}, "ingress.drop_over")
    spared = names.entry(
        "ingress.limit_spared", {"slot": SLOT, "is_ipv4": 1, "src": RESOLVER}, "ingress.spare_source"
    )
    limit = names.entry("ingress.limit", match, "ingress.limit_rate", [SLOT], priority=9)
    bare.write(
        insert(names.entry("ingress.forward_port", {"ingress_port": 1}, "ingress.to_port", [2])),
        insert(over),
        insert(metered(spared, 2)),
        insert(metered(limit, 5)),
    )
    return bare, over, limit


def counted(controller, entity):
    asked = p4runtime.Entity()
    asked.table_entry.CopyFrom(entity.table_entry)
    asked.table_entry.ClearField("action")
    asked.table_entry.ClearField("meter_config")
    asked.table_entry.counter_data.SetInParent()
    (found,) = controller.read(asked)
    return found.table_entry.counter_data.packet_count


def test_the_burst_passes_and_the_rest_is_counted(target, limited):
    controller, over, limit = limited
    answers = [frame(number) for number in range(9)]
    others = [frame(20, port=123), frame(21, target=RESOLVER)]
    target.inject(1, *answers, *others)
    assert target.sent(2, 7) == [*answers[:5], *others]
    assert (counted(controller, over), counted(controller, limit)) == (4, 9)


def segment(number, port, flags=0x02):
    """A TCP segment to the victim, by default a SYN."""
    head = bytes.fromhex("45000028") + number.to_bytes(2, "big") + bytes.fromhex("000040060000")
    ends = (0x0A000001).to_bytes(4, "big") + VICTIM.to_bytes(4, "big")
    ports = (40_000).to_bytes(2, "big") + port.to_bytes(2, "big")
    return _ETHERNET + head + ends + ports + bytes(8) + bytes([0x50, flags]) + bytes(6)


def test_syns_to_open_ports_pass_whatever_the_limit_of_others_is(target, bare):
    """As the controller limits a scan: open ports come first, with a meter that nothing exceeds."""
    target.drain()
    config = program_config(PROGRAM.with_suffix(""))
    bare.set_pipeline(config)
    names = EntryBuilder(config.p4info)
    syns = {"is_ipv4": (1, 1), "dst": (VICTIM, ADDRESS), "protocol": (6, 0xFF), "tcp_flags": (0x02, 0x12)}
    limit = names.entry("ingress.limit", syns, "ingress.limit_rate", [SLOT], priority=9)
    web = {"dport": (443, 0xFFFF)}
    is_open = names.entry("ingress.limit", syns | web, "ingress.limit_rate", [SLOT], priority=10)
    meter = is_open.table_entry.meter_config
    meter.cir = meter.cburst = meter.pir = meter.pburst = 1 << 31
    over = names.entry("ingress.limit_over", {"slot": SLOT}, "ingress.drop_over")
    bare.write(
        insert(names.entry("ingress.forward_port", {"ingress_port": 1}, "ingress.to_port", [2])),
        insert(over),
        insert(is_open),
        insert(metered(limit, 2)),
    )
    scan = [segment(number, 1_000 + number) for number in range(6)]
    clients = [segment(10 + number, 443) for number in range(6)]
    others = [segment(20, 1_003, flags=0x10), segment(21, 1_004, flags=0x12)]
    target.inject(1, *scan, *clients, *others)
    assert target.sent(2, 10) == [*scan[:2], *clients, *others]
    assert counted(bare, over) == 4


def test_a_spared_source_has_its_own_burst_beyond_the_limit(target, limited):
    controller, over, _ = limited
    target.inject(1, *[frame(number) for number in range(6)])
    assert len(target.sent(2, 5)) == 5
    own = [frame(10 + number, source=RESOLVER) for number in range(4)]
    target.inject(1, *own, frame(30, port=123))
    assert target.sent(2, 3) == [*own[:2], frame(30, port=123)]
    assert counted(controller, over) == 1 + 2


def test_meters_are_read_back_and_changed(target, limited):
    """As part of the entry, and as direct meter entry: a changed meter has full buckets."""
    controller, _, limit = limited
    asked = p4runtime.Entity()
    asked.table_entry.CopyFrom(limit.table_entry)
    asked.table_entry.ClearField("action")
    asked.table_entry.meter_config.SetInParent()
    (found,) = controller.read(asked)
    assert found.table_entry.meter_config == limit.table_entry.meter_config
    answers, last = [frame(number) for number in range(6)], frame(30, port=123)
    target.inject(1, *answers, last)
    assert target.sent(2, 6) == [*answers[:5], last]  # the sixth is dropped before the meter is changed
    direct = p4runtime.Entity()
    direct.direct_meter_entry.table_entry.CopyFrom(limit.table_entry)
    direct.direct_meter_entry.table_entry.ClearField("action")
    direct.direct_meter_entry.table_entry.ClearField("meter_config")
    direct.direct_meter_entry.config.cburst = direct.direct_meter_entry.config.pburst = 3
    controller.write(modify(direct))
    more = [frame(40 + number) for number in range(5)]
    target.inject(1, *more)
    assert target.sent(2, 3) == more[:3]
