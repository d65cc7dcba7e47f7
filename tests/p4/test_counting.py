"""Cells of the counting stages with the source port in their key, counted and read in band."""

from dataplane.tables import Ternary
from tests.p4.sdnator_switch import entry, ethernet, mac, udp, want_all

_ADDRESS, _SHORT = (1 << 128) - 1, (1 << 16) - 1
_SECOND = 1_000_000
_FIELDS = (("egress_port", 9), ("operation", 7), ("query", 32), ("source", 128), ("destination", 128))
_FIELDS += (("port", 16), ("length", 16), ("source_port", 16), ("timestamp", 48))


def counting(switch, *, source_port):
    want_all(switch)
    params = (0, 1, _ADDRESS, 0, 0, 0, 0, 0, -(-(1 << 64) // _SECOND), 0, 1024, 0, source_port)
    table = switch.tables["ingress.count_0.queries"]
    table.insert(entry((Ternary(1, 1),), "count_0.count", *params, priority=1))


def count_of(switch, **key):
    """The count that the switch answers for a key."""
    values = {"operation": 1, **key}
    bits = 0
    for name, width in _FIELDS:
        bits = bits << width | values.get(name, 0)
    request = bits.to_bytes(sum(width for _, width in _FIELDS) // 8, "big")
    (answer,) = switch.packet_out(request, 20).packet_ins
    return int.from_bytes(answer[12:16], "big")


def test_each_source_port_has_its_cell(switch):
    counting(switch, source_port=_SHORT)
    for port in (1000, 1000, 1001):
        switch.process(1, ethernet(mac(1), mac(2), udp(source_port=port)), 5)
    window = {"source": 0x0A000001, "timestamp": 10}
    assert count_of(switch, **window, source_port=1000) == 2
    assert count_of(switch, **window, source_port=1001) == 1
    assert count_of(switch, **window, source_port=1002) == 0


def test_without_the_mask_ports_share_a_cell(switch):
    counting(switch, source_port=0)
    for port in (1000, 1000, 1001):
        switch.process(1, ethernet(mac(1), mac(2), udp(source_port=port)), 5 * _SECOND)
    window = {"source": 0x0A000001, "timestamp": 5 * _SECOND + 1}
    assert count_of(switch, **window) == 3
    assert count_of(switch, **window, source_port=1000) == 3


def test_written_cells_are_found_among_a_million(switch):
    """The highest cell of the largest array, and a wide one."""
    for name, index, value in (("guard_syns", (1 << 20) - 1, 77), ("count_7.cells", 65_535, (1 << 375) + 5)):
        array = switch.registers[f"ingress.{name}"]
        array.write(index, value)
        assert array.written() == [(index, value)]
