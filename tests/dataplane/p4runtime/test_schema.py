"""A p4info is taken only with the program that it was compiled with."""

from pathlib import Path

import pytest

from dataplane.p4runtime.pipeline import verify
from dataplane.p4runtime.status import InvalidArgument
from sdnator.testing.p4runtime_client import program_config
from tests.requirements import shared_data

PROGRAMS = Path(__file__).parents[1] / "programs"


def features():
    return program_config(PROGRAMS / "features")


def test_programs_fit_their_own_p4info():
    schema = verify(features()).schema
    assert {table.spec.name for table in schema.tables.values()} == {
        "I.route", "I.ports", "I.flows", "I.maybe", "I.fixed",
    }  # fmt: skip
    assert [(field.name, field.width) for field in schema.packet_in] == [("ingress_port", 9), ("reason", 7)]
    for name in ("small", "sketch"):
        verify(program_config(shared_data(f"p4/{name}.json").with_suffix("")))


def _key(info):
    info.tables[0].match_fields[0].bitwidth += 1


def _header(info):
    info.controller_packet_metadata[0].metadata[0].bitwidth += 8


def _endless(info):
    struct = info.digests[0].type_spec.struct.name
    for member in info.type_info.structs[struct].members:
        member.type_spec.struct.name = struct


CHANGES = {
    "two tables with the same id": lambda info: info.tables.append(info.tables[0]),
    "members within members without end": _endless,
    "not of 1..512 bits": lambda info: setattr(
        info.controller_packet_metadata[0].metadata[0], "bitwidth", 1 << 30
    ),
    "table I.": lambda info: info.tables.pop(0),
    "has the key": _key,
    "has size": lambda info: setattr(info.tables[0], "size", 3),
    "idle time-out": lambda info: setattr(
        info.tables[0], "idle_timeout_behavior", 1 - info.tables[0].idle_timeout_behavior
    ),
    "parameters": lambda info: [setattr(p, "bitwidth", 99) for action in info.actions for p in action.params],
    "counter I.seen": lambda info: info.counters.pop(),
    "meter I.rate": lambda info: setattr(info.meters[0], "size", 1),
    "register": lambda info: setattr(info.registers[0].type_spec.bitstring.bit, "bitwidth", 1),
    "digest": lambda info: setattr(info.digests[0].preamble, "name", "other"),
    "header packet_in": _header,
    "action profile": lambda info: setattr(info.tables[0], "implementation_id", 1),
}


@pytest.mark.parametrize("text", CHANGES)
def test_each_contradiction_is_named(text):
    config = features()
    CHANGES[text](config.p4info)
    with pytest.raises(InvalidArgument, match=text):
        verify(config)


def test_a_p4info_of_another_program_is_refused():
    config = features()
    config.p4_device_config = shared_data("p4/small.json").read_bytes()
    with pytest.raises(InvalidArgument, match="same compilation"):
        verify(config)


def test_no_json_and_broken_json_are_refused():
    config = features()
    config.p4_device_config = b""
    with pytest.raises(InvalidArgument, match="p4c"):
        verify(config)
    config.p4_device_config = b"{"
    with pytest.raises(InvalidArgument, match="p4_device_config"):
        verify(config)
