"""A pipeline that is set: the program, its schema, a running switch and the entities on it.

ForwardingPipelineConfig ── verify() ──► Verified ── Pipeline(…) ──► writes.py, reads.py, packet_loop.py
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from dataplane.compiler.c_machine import CMachine
from dataplane.compiler.machine import MachineMaker
from dataplane.errors import DataplaneError, ProgramError
from dataplane.p4runtime.array_entities import ArrayEntities
from dataplane.p4runtime.digests import DigestLists
from dataplane.p4runtime.packet_io import PacketInEncoder, PacketOutDecoder
from dataplane.p4runtime.replication_entities import ReplicationEntities
from dataplane.p4runtime.schema import Schema, bind
from dataplane.p4runtime.status import InvalidArgument
from dataplane.p4runtime.table_entities import TableEntities
from dataplane.v1model.program import load
from dataplane.v1model.switch import Switch
from dataplane.v1model.tree import Program


@dataclass(frozen=True, slots=True)
class Verified:
    """A configuration that this target can realise."""

    config: Any
    program: Program
    schema: Schema


def verify(config: Any) -> Verified:
    """Check a ForwardingPipelineConfig: the BMv2 JSON loads, and the p4info fits it.

    Raises InvalidArgument with the reason.
    """
    if not config.p4_device_config:
        raise InvalidArgument("the configuration has no p4_device_config: send the BMv2 JSON that p4c wrote")
    try:
        program = load(bytes(config.p4_device_config))
    except ProgramError as error:
        raise InvalidArgument(f"p4_device_config: {error}") from error
    kept = type(config)()
    kept.CopyFrom(config)
    return Verified(kept, program, bind(config.p4info, program))


class ForwardingPipeline:
    """A verified configuration in force.

    cpu_port: number of the port that packet-ins leave by
    maker: see Switch
    clock: the packets' clock, µs

    Raises InvalidArgument where the program cannot be compiled.
    """

    def __init__(
        self, verified: Verified, *, cpu_port: int, maker: MachineMaker = CMachine, clock: Callable[[], int]
    ) -> None:
        self.config = verified.config
        self.schema = verified.schema
        try:
            self.switch = Switch(verified.program, cpu_port=cpu_port, maker=maker)
        except DataplaneError as error:
            raise InvalidArgument(f"p4_device_config: {error}") from error
        self.tables = TableEntities(self.schema, self.switch, clock)
        self.arrays = ArrayEntities(self.schema, self.switch)
        self.replication = ReplicationEntities(self.switch)
        self.digests = DigestLists(self.schema)
        self.packet_in = PacketInEncoder(self.schema.packet_in)
        self.packet_out = PacketOutDecoder(self.schema.packet_out)

    def take(self, config: Any) -> bool:
        """Take over a configuration with the same program, and its cookie; whether it has the same."""
        same = bool(
            config.p4_device_config == self.config.p4_device_config and config.p4info == self.config.p4info
        )
        if same:
            self.config.CopyFrom(config)
        return same

    def close(self) -> None:
        """Free the switch."""
        self.switch.close()
