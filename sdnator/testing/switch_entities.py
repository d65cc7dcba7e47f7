"""One P4Runtime entity of each kind."""

from typing import Any

from p4rt import p4runtime
from sdnator.testing.p4runtime_client import EntryBuilder, clone_session


def every_entity(builder: EntryBuilder) -> list[Any]:
    """Entities of each kind that P4Runtime writes or reads, for the program of `tests/dataplane/programs/features.p4`."""
    info, made = builder.info, [p4runtime.Entity() for _ in range(8)]
    made[0].counter_entry.counter_id = info.counters[0].preamble.id
    made[0].counter_entry.index.index = 3
    made[0].counter_entry.data.packet_count = 5
    made[1].meter_entry.meter_id = info.meters[0].preamble.id
    made[1].meter_entry.config.cir = made[1].meter_entry.config.pir = 5
    made[2].register_entry.register_id = info.registers[0].preamble.id
    made[2].register_entry.data.bitstring = b"\x05"
    made[3].digest_entry.digest_id = info.digests[0].preamble.id
    made[3].digest_entry.config.max_list_size = 3
    group = made[4].packet_replication_engine_entry.multicast_group_entry
    group.multicast_group_id = 3
    group.replicas.add(egress_port=2, instance=1)
    match = {"h.test.c": (1, 9), "h.test.d": (0x100, 0xF00), "h.test.a": 4}
    flow = builder.entry("I.flows", match, "I.metered", [2], priority=3)
    flow.table_entry.meter_config.cir = flow.table_entry.meter_config.pir = 7
    route = builder.entry("I.route", {"h.ip.dst": (0x0A000000, 8)}, "I.counted", [3], idle_timeout_ns=5)
    made[5].direct_counter_entry.table_entry.CopyFrom(route.table_entry)
    made[6].direct_meter_entry.table_entry.CopyFrom(flow.table_entry)
    made[7].table_entry.SetInParent()
    maybe = builder.entry("I.maybe", {"h.test.b": 1}, "I.label_as", [1, 2], priority=1)
    return [*made, flow, route, maybe, builder.default("I.route", "I.counted", [3]), clone_session(5, 510)]
