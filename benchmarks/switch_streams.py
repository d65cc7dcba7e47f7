"""Packet-ins and digests: how many a second reach a consumer, beside a bare gRPC stream of the same message."""

import statistics
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import grpc

from benchmarks.switch_stage import (
    PACKETS_KEY,
    ArrivalCounter,
    SwitchProcess,
    SwitchStage,
    every_packet,
    feed_process,
    frame,
    primary,
    process,
    program,
)
from p4rt import INSECURE, P4RuntimeStub, open_channel, p4runtime
from sdnator.testing.p4runtime_client import EntryBuilder, P4RuntimeClient, insert

WARM_UP = 2_000
DIGEST_LIST = 500
DIGEST_TIMEOUT_NS = 5_000_000


def packet_in_message(number: int) -> Any:
    """A StreamMessageResponse with the packet-in that the program makes of `frame()`."""
    response = p4runtime.StreamMessageResponse()
    response.packet.payload = frame()
    values = {
        "ingress_port": 1,
        "timestamp": number,
        "length": 90,
        "sequence": number + 1,
        "arrival": number,
        "query_map": 1,
    }
    for header in program().p4info.controller_packet_metadata:
        for field in header.metadata if header.preamble.name == "packet_in" else ():
            value = values.get(field.name, 0)
            text = value.to_bytes(max(1, (value.bit_length() + 7) // 8), "big")
            response.packet.metadata.add(metadata_id=field.id, value=text)
    return response


def raw_server(pipe: Any, count: int) -> None:
    """A gRPC server whose stream sends `count` messages that were built before."""
    template = packet_in_message(0)
    messages = []
    for number in range(count):
        message = p4runtime.StreamMessageResponse()
        message.CopyFrom(template)
        message.packet.metadata[-2].value = number.to_bytes(4, "big")
        messages.append(message)

    def stream(requests: Any, _context: grpc.ServicerContext) -> Any:
        next(requests)
        yield from messages

    handler = grpc.stream_stream_rpc_method_handler(
        stream,
        request_deserializer=p4runtime.StreamMessageRequest.FromString,
        response_serializer=p4runtime.StreamMessageResponse.SerializeToString,
    )
    server = grpc.server(ThreadPoolExecutor(4))
    server.add_generic_rpc_handlers(
        (grpc.method_handlers_generic_handler("p4.v1.P4Runtime", {"StreamChannel": handler}),)
    )
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    pipe.send("ready")
    pipe.send(port)
    pipe.recv()
    server.stop(0).wait()


def raw_rate(port: int) -> float:
    """Messages per second of one whole stream."""
    with open_channel(f"127.0.0.1:{port}", INSECURE) as channel:
        stream = P4RuntimeStub(channel).StreamChannel(iter([p4runtime.StreamMessageRequest()]))
        next(stream)
        start, count = time.monotonic(), 0
        for _ in stream:
            count += 1
        return count / (time.monotonic() - start)


def packet_in(folder: Path, rounds: int, count: int) -> dict[str, float]:
    """Packet-ins through gRPC and the controller to a DUE consumer, in turn with the bare stream."""
    stage = SwitchStage(folder)
    seen = ArrivalCounter()
    try:
        subscription = (
            stage.engine("bench").observe(PACKETS_KEY).subscribe(lambda item: seen.add(len(item.value)))
        )
        with process(raw_server, count) as raw, process(feed_process, stage.switch.socket, [frame()]) as feed:
            port = raw.recv()
            _settle(feed, seen)
            pairs = [(raw_rate(port), _rate(feed, seen, count)) for _ in range(rounds)]
        subscription.dispose()
    finally:
        stage.close()
    return {
        "raw_grpc_msgs_per_s": statistics.median(raw for raw, _ in pairs),
        "packet_in_pps": statistics.median(ours for _, ours in pairs),
        "packet_in_ratio_vs_raw_grpc": statistics.median(ours / raw for raw, ours in pairs),
    }


def _settle(feed: Any, seen: ArrivalCounter) -> None:
    """Feed until all frames of a round arrive: the request for packets is then in force."""
    for _ in range(50):
        seen.expect(WARM_UP)
        feed.send(WARM_UP)
        feed.recv()
        try:
            seen.wait("warm-up", 1.0)
        except RuntimeError:
            continue
        return
    raise RuntimeError("the controller does not publish packets")


def _rate(feed: Any, seen: ArrivalCounter, count: int) -> float:
    seen.expect(count)
    feed.send(count)
    end = seen.wait("packets")
    return count / (end - float(feed.recv()))


def bare(folder: Path, rounds: int, count: int, *, digests: bool) -> float:
    """Packet-ins, or samples in digest lists, that reach a plain P4Runtime client per second."""
    switch = SwitchProcess(folder)
    controller = primary(switch.address)
    try:
        names = EntryBuilder(program().p4info)
        every_packet(controller, names, copies=not digests, digests=digests)
        if digests:
            controller.write(insert(digest_entry(names)))
        seen = ArrivalCounter()
        count_stream(controller, seen)
        with process(feed_process, switch.socket, [frame()]) as feed:
            _settle(feed, seen)
            return statistics.median(_rate(feed, seen, count) for _ in range(rounds))
    finally:
        controller.close()
        switch.close()


def digest_entry(names: EntryBuilder) -> Any:
    """Lists of 500, or what there is after 5 ms."""
    entity = p4runtime.Entity()
    frames = next(d for d in names.info.digests if d.preamble.name == "frame_digest_t")
    entity.digest_entry.digest_id = frames.preamble.id
    entity.digest_entry.config.max_timeout_ns = DIGEST_TIMEOUT_NS
    entity.digest_entry.config.max_list_size = DIGEST_LIST
    return entity


def count_stream(controller: P4RuntimeClient, seen: ArrivalCounter) -> None:
    """Count instead of keeping what arrives."""

    class Counter:
        def put(self, message: Any) -> None:
            seen.add(len(message.data) if message.DESCRIPTOR.name == "DigestList" else 1)

    controller.sinks["packet"] = controller.sinks["digest"] = Counter()
