"""The product's program on every target: a difference is reported when its window is over, and not before."""

import pytest

from p4rt import p4runtime
from sdnator.testing.p4runtime_client import TIMEOUT_S, EntryBuilder, insert, modify, program_config, text
from sdnator.testing.product_program import PROGRAM

_HOUR_US = 3_600_000_000
_ZERO = 1 << 31
_ADDRESS = (1 << 128) - 1
_HOST = 0x0A000001
_FIELDS = ("link", "src", "dst", "l4", "sport", "dport")
_FRAME = bytes(12) + b"\x08\0" + bytes.fromhex("4500001c0001000040110000 0a000001 0a000002 03e8003500080000")


@pytest.fixture
def counting(target, bare):
    """A primary on a switch that counts the frames of each host, and reports two or more."""
    target.drain()
    config = program_config(PROGRAM.with_suffix(""))
    bare.set_pipeline(config)
    names = EntryBuilder(config.p4info)
    given = {"bit_of_query": 1, "source_mask": _ADDRESS, "threshold": _ZERO + 2, "size": 64, "generation": 1}
    given |= {"count_of": 9, "reciprocal": -(-(1 << 64) // _HOUR_US)}
    action = names.actions["ingress.count_3.difference"]
    params = [given.get(param.name, 0) for param in action.params]
    key = {"query_map": (1, 1)}
    bare.write(
        *(modify(names.default(f"ingress.telemetry_{one}", f"ingress.match_{one}", [1])) for one in _FIELDS),
        modify(names.default("ingress.telemetry_active", "ingress.set_active", [1, 0, 0])),
        insert(names.entry("ingress.forward_port", {"ingress_port": 1}, "ingress.to_port", [2])),
        insert(names.entry("ingress.count_3.queries", key, "ingress.count_3.difference", params, priority=1)),
        *(insert(_digest(one.preamble.id)) for one in config.p4info.digests),
    )
    return bare, config.p4info


def _digest(number):
    entity = p4runtime.Entity()
    entity.digest_entry.digest_id = number
    entity.digest_entry.config.max_list_size = 1
    return entity


def _ask(controller, info, **header):
    """A packet-out with a question → the fields of its answer."""
    out, back = (
        next(one for one in info.controller_packet_metadata if one.preamble.name == name).metadata
        for name in ("packet_out", "packet_in")
    )
    controller.packet_out(b"question", {field.id: text(header.get(field.name, 0)) for field in out})
    packet = controller.packets.get(timeout=TIMEOUT_S)
    assert packet.payload == b"question"
    names = {field.id: field.name for field in back}
    return {names[one.metadata_id]: int.from_bytes(one.value, "big") for one in packet.metadata}


def test_a_difference_is_reported_when_its_window_is_over(target, counting):
    controller, info = counting
    target.inject(1, _FRAME, _FRAME)
    assert target.sent(2, 2) == [_FRAME] * 2
    cell = _ask(controller, info, operation=1, key_source=_HOST)
    assert (cell["reason"], cell["sequence"], cell["query_map"]) == (1, _ZERO + 2, 0)
    early = _ask(controller, info, operation=2, key_length=1)
    assert (early["sequence"], early["arrival"]) == (0, 0)
    assert controller.digests.empty()
    later = (cell["arrival"] + 1) * _HOUR_US + 5
    assert _ask(controller, info, operation=2, key_length=1, timestamp=later)["sequence"] == 0
    (report,) = controller.digests.get(timeout=TIMEOUT_S).data
    members = [int.from_bytes(one.bitstring, "big") for one in report.struct.members]
    assert members == [9, cell["arrival"], 2, _HOST, 0, 0, 0, 0, later]
