"""Whatever a controller sends, it is carried out or refused with a code: nothing else comes out."""

import random
from pathlib import Path

import pytest
from google.protobuf.message import DecodeError

from dataplane.device import Device
from dataplane.status import Refused, details
from p4rt import p4runtime, status
from tests.dataplane.controller import Names, clone_session, delete, insert, modify, program_config
from tests.requirements import require_program

PROGRAM = Path(__file__).parent / "programs" / "features"
TRIES = 1500


@pytest.fixture(params=["python", "c"])
def device(request):
    if request.param == "c":
        require_program("gcc")
    made = Device(1, backend=request.param, clock=lambda: 0)
    update = p4runtime.MasterArbitrationUpdate(device_id=1)
    update.election_id.low = 1
    made.stream = made.open_stream()
    made.arbitrate(made.stream, update)
    request = p4runtime.SetForwardingPipelineConfigRequest(
        device_id=1, action=3, config=program_config(PROGRAM)
    )
    request.election_id.low = 1
    made.set_pipeline(request)
    yield made
    made.close()


def entities(names):
    """One of each kind."""
    info, made = names.info, [p4runtime.Entity() for _ in range(8)]
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
    flow = names.entry("I.flows", match, "I.metered", [2], priority=3)
    flow.table_entry.meter_config.cir = flow.table_entry.meter_config.pir = 7
    route = names.entry("I.route", {"h.ip.dst": (0x0A000000, 8)}, "I.counted", [3], idle_timeout_ns=5)
    made[5].direct_counter_entry.table_entry.CopyFrom(route.table_entry)
    made[6].direct_meter_entry.table_entry.CopyFrom(flow.table_entry)
    made[7].table_entry.SetInParent()
    maybe = names.entry("I.maybe", {"h.test.b": 1}, "I.label_as", [1, 2], priority=1)
    return [*made, flow, route, maybe, names.default("I.route", "I.counted", [3]), clone_session(5, 510)]


def mutated(data, chance):
    """Some bytes changed, dropped or doubled."""
    out = bytearray(data)
    for _ in range(chance.choice((0, 0, 1, 1, 2, 4))):
        place = chance.randrange(len(out))
        what = chance.random()
        if what < 0.9:
            out[place] = chance.choice((0, 1, 0x7F, 0x80, 0xFF, chance.randrange(256)))
        elif what < 0.95:
            del out[place : place + chance.randint(1, 3)]
        else:
            out[place:place] = out[place : place + chance.randint(1, 8)]
        if not out:
            out = bytearray(data)
    return bytes(out)


def update(pieces, chance):
    """A message that is one, whatever is in it."""
    while True:
        try:
            return p4runtime.Update.FromString(mutated(chance.choice(pieces), chance))
        except DecodeError:
            continue


@pytest.mark.parametrize("seed", range(2))
def test_writes_and_reads_of_any_kind(device, seed):
    chance, names = random.Random(seed), Names(program_config(PROGRAM).p4info)
    pieces = [
        one(entity).SerializeToString() for entity in entities(names) for one in (insert, modify, delete)
    ]
    done = 0
    for _ in range(TRIES):
        updates = [update(pieces, chance) for _ in range(3)]
        request = p4runtime.WriteRequest(device_id=1, updates=updates, atomicity=chance.randrange(3))
        request.election_id.low = 1
        results = device.write(request)
        if results:
            assert len(status.Status.FromString(details(results, "Write")).details) == 3
        done += sum(error is None for error in results) if results else 3
        _, refused = device.read(p4runtime.ReadRequest(device_id=1, entities=[u.entity for u in updates]))
        assert len(refused) in (0, 3)
    assert done > TRIES / 20


def test_stream_messages_of_any_kind(device):
    chance, sent = random.Random(7), []
    device.on_packet_out = sent.append
    request = p4runtime.StreamMessageRequest()
    request.packet.payload = bytes(20)
    request.packet.metadata.add(metadata_id=1, value=b"\x03")
    request.packet.metadata.add(metadata_id=2, value=b"\x00")
    ack = p4runtime.StreamMessageRequest()
    ack.digest_ack.digest_id, ack.digest_ack.list_id = 5, 1
    pieces = [request.SerializeToString(), ack.SerializeToString()]
    for _ in range(TRIES):
        try:
            message = p4runtime.StreamMessageRequest.FromString(mutated(chance.choice(pieces), chance))
            if message.WhichOneof("update") == "digest_ack":
                device.acknowledge(device.stream, message.digest_ack)
            else:
                device.packet_out(device.stream, message.packet)
        except (DecodeError, Refused):
            continue
    assert sent
    assert all(len(payload) >= 2 for payload in sent)
