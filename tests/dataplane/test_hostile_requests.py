"""Whatever a controller sends, it is carried out or refused with a code: nothing else comes out."""

import random
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.message import DecodeError

from dataplane.p4runtime.device import Device
from dataplane.p4runtime.status import Refused, details
from dataplane.p4runtime.trust import AnyProgram
from p4rt import p4runtime, status
from sdnator.testing.p4runtime_client import (
    EntryBuilder,
    delete,
    insert,
    modify,
    program_config,
)
from sdnator.testing.switch_entities import every_entity
from tests.dataplane.loading import MAKERS

PROGRAM = Path(__file__).parent / "programs" / "features"
TRIES = 1500


@pytest.fixture(params=MAKERS)
def controlled(request):
    """A device, and the stream of its primary controller."""
    made: Any = Device(1, maker=request.param, clock=lambda: 0, programs=AnyProgram())
    update = p4runtime.MasterArbitrationUpdate(device_id=1)
    update.election_id.low = 1
    stream = made.open_stream()
    made.arbitrate(stream, update)
    request = p4runtime.SetForwardingPipelineConfigRequest(
        device_id=1, action=3, config=program_config(PROGRAM)
    )
    request.election_id.low = 1
    made.set_pipeline(request)
    yield made, stream
    made.close()


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
def test_writes_and_reads_of_any_kind(controlled, seed):
    device, _ = controlled
    chance, builder = random.Random(seed), EntryBuilder(program_config(PROGRAM).p4info)
    pieces = [
        one(entity).SerializeToString()
        for entity in every_entity(builder)
        for one in (insert, modify, delete)
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
        reading = device.read(p4runtime.ReadRequest(device_id=1, entities=[u.entity for u in updates]))
        while reading.page() is not None:
            pass
        assert len(reading.results) == 3
    assert done > TRIES / 20


def test_stream_messages_of_any_kind(controlled):
    device, stream = controlled
    chance = random.Random(7)
    sent: list[bytes] = []
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
                device.acknowledge(stream, message.digest_ack)
            else:
                device.packet_out(stream, message.packet)
        except (DecodeError, Refused):
            continue
    assert sent
    assert all(len(payload) >= 2 for payload in sent)
