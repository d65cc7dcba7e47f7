"""Whatever bytes come over the wire, the server answers with a status of gRPC and goes on forwarding."""

import random
import threading
from pathlib import Path

import grpc
import pytest

from dataplane.p4runtime.trust import AnyProgram
from p4rt import p4runtime
from sdnator.testing.p4runtime_client import (
    TIMEOUT_S,
    EntryBuilder,
    P4RuntimeClient,
    insert,
    modify,
    program_config,
    update_errors,
)
from sdnator.testing.switch_double import SwitchDouble
from sdnator.testing.switch_entities import every_entity
from tests.dataplane.p4runtime.test_device import frame, number_of, until
from tests.dataplane.p4runtime.test_reads import whole_table
from tests.dataplane.test_hostile_requests import mutated

PROGRAM = Path(__file__).parent / "programs" / "features"
SERVICE = "/p4.v1.P4Runtime/"
TRIES = 150
STREAMS = 40
LARGE = 65 << 20
MEANT = {
    "OK", "INVALID_ARGUMENT", "NOT_FOUND", "ALREADY_EXISTS", "PERMISSION_DENIED", "RESOURCE_EXHAUSTED",
    "FAILED_PRECONDITION", "ABORTED", "OUT_OF_RANGE", "UNIMPLEMENTED",
}  # fmt: skip
"""Beside these only UNKNOWN for a batch, which has details."""


@pytest.fixture
def switch():
    with SwitchDouble(programs=AnyProgram()) as made:
        yield made


@pytest.fixture
def controller(switch):
    with P4RuntimeClient(switch.address) as made:
        made.arbitrate()
        made.set_pipeline(program_config(PROGRAM))
        yield made


def still_works(switch, controller):
    controller.set_pipeline(program_config(PROGRAM))
    switch.memory[1].inject(frame(99))
    until(lambda: number_of(controller.packets.get(timeout=TIMEOUT_S)) == 99)


def judged(error):
    code, text = error.code().name, error.details()
    assert "Unexpected" not in text, text
    if code == "UNKNOWN":
        assert any(key == "grpc-status-details-bin" for key, _ in error.trailing_metadata()), text
    else:
        assert code in MEANT, (code, text)


def seeds(controller):
    """Some requests of each kind that are carried out."""
    names = EntryBuilder(program_config(PROGRAM).p4info)
    every = every_entity(names)
    writes = [controller.write_request(make(one)) for one in every for make in (insert, modify)]
    reads = [p4runtime.ReadRequest(device_id=1, entities=[one]) for one in [*every, whole_table(names)]]
    sets = p4runtime.SetForwardingPipelineConfigRequest(device_id=1, action=1)
    sets.election_id.low = 1
    sets.config.CopyFrom(program_config(PROGRAM))
    asks = p4runtime.GetForwardingPipelineConfigRequest(device_id=1)
    return {
        "Write": writes, "Read": reads, "SetForwardingPipelineConfig": [sets],
        "GetForwardingPipelineConfig": [asks], "Capabilities": [p4runtime.CapabilitiesRequest(device_id=1)],
    }  # fmt: skip


@pytest.mark.parametrize(
    "call", ["Write", "Read", "SetForwardingPipelineConfig", "GetForwardingPipelineConfig"]
)
def test_mutated_requests(switch, controller, call):
    chance, pieces = random.Random(5), [one.SerializeToString() for one in seeds(controller)[call]]
    with grpc.insecure_channel(switch.address) as channel:
        kind = channel.unary_stream if call == "Read" else channel.unary_unary
        method = kind(SERVICE + call, request_serializer=None, response_deserializer=None)
        for _ in range(TRIES if len(pieces) > 1 else TRIES // 3):
            data = chance.choice(pieces)
            for _ in range(chance.randint(1, 3)):
                data = mutated(data, chance) or b"\0"
            try:
                answer = method(data, timeout=TIMEOUT_S)
                if call == "Read":
                    list(answer)
            except grpc.RpcError as error:
                judged(error)
    still_works(switch, controller)


def test_mutated_streams(switch, controller):
    """Each ends by itself or goes on; none takes the others along."""
    chance = random.Random(9)
    hello = p4runtime.StreamMessageRequest()
    hello.arbitration.device_id = 1
    hello.arbitration.election_id.low = 7
    packet = p4runtime.StreamMessageRequest()
    packet.packet.payload = bytes(40)
    packet.packet.metadata.add(metadata_id=1, value=b"\x03")
    ack = p4runtime.StreamMessageRequest()
    ack.digest_ack.digest_id = 5
    pieces = [each.SerializeToString() for each in (hello, packet, ack)]
    with grpc.insecure_channel(switch.address) as channel:
        method = channel.stream_stream(SERVICE + "StreamChannel", None, None)
        for _ in range(STREAMS):
            messages = [mutated(chance.choice(pieces), chance) for _ in range(chance.randint(1, 20))]
            call = method(iter(messages), timeout=TIMEOUT_S)
            try:
                list(call)
            except grpc.RpcError as error:
                judged(error)
    controller.election_id = 1 << 100
    controller.ask_for_arbitration()
    # notices about the streams above, which were primary now and then, may come before the answer
    until(lambda: controller.arbitrations.get(timeout=TIMEOUT_S).election_id.high == 1 << 36)
    still_works(switch, controller)


def test_a_message_that_is_too_large_is_refused_by_its_size(switch, controller):
    request = controller.write_request(*[p4runtime.Update()])
    request.updates[0].entity.table_entry.metadata = bytes(LARGE)
    with pytest.raises(grpc.RpcError) as caught:
        controller.stub.Write(request, timeout=TIMEOUT_S)
    assert caught.value.code().name == "RESOURCE_EXHAUSTED"
    still_works(switch, controller)


def test_more_updates_than_one_write_may_have(switch, controller):
    with pytest.raises(grpc.RpcError) as caught:
        controller.write(*[p4runtime.Update()] * ((1 << 17) + 1))
    assert caught.value.code().name == "RESOURCE_EXHAUSTED"
    assert "131072" in caught.value.details()
    still_works(switch, controller)


def test_an_entry_and_a_group_are_not_of_any_size(switch, controller):
    names = EntryBuilder(program_config(PROGRAM).p4info)
    entry = names.entry("I.ports", {"sm.ingress_port": 1}, "I.forward", [2], metadata=bytes(4097))
    group = p4runtime.Entity()
    made = group.packet_replication_engine_entry.multicast_group_entry
    made.multicast_group_id = 1
    for number in range(1025):
        made.replicas.add(egress_port=number % 500, instance=number)
    with pytest.raises(grpc.RpcError) as caught:
        controller.write(insert(entry), insert(group))
    assert [error.canonical_code for error in update_errors(caught.value)] == [3, 8]
    still_works(switch, controller)


def test_a_packet_out_that_is_no_frame_is_told_without_being_sent_back(switch, controller):
    controller.packet_out(bytes(1 << 20), {1: b"\x03", 2: b"\x00"})
    told = controller.others.get(timeout=TIMEOUT_S)
    assert "packet-out of 1048576 bytes" in told.message
    assert told.ByteSize() < 1000
    still_works(switch, controller)


def test_a_controller_that_reads_nothing_of_its_errors_is_not_kept_in_memory(switch, controller):
    """Answers to a stream are bounded in number; the thread of the others goes on."""
    silent = threading.Event()

    def requests():
        hello = p4runtime.StreamMessageRequest()
        hello.arbitration.device_id = 1
        yield hello.SerializeToString()
        for _ in range(20_000):
            yield p4runtime.StreamMessageRequest().SerializeToString()
        silent.wait(TIMEOUT_S)

    with grpc.insecure_channel(switch.address) as channel:
        call = channel.stream_stream(SERVICE + "StreamChannel", None, None)(requests())
        still_works(switch, controller)
        waiting = [len(stream._control) for stream in switch.device._streams.values()]
        assert max(waiting) <= 4096
        silent.set()
        call.cancel()
