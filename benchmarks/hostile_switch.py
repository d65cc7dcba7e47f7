"""The embedded switch: programs, p4info, P4Runtime requests to a device and to a live server, frames."""

import atexit
import random
import tempfile
import threading
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import grpc
from google.protobuf.message import DecodeError

from benchmarks.hostile_messages import frames
from benchmarks.hostile_mutation import mutate_json, mutate_protobuf
from benchmarks.hostile_target import DecoderTarget
from dataplane.compiler import layout
from dataplane.compiler.c_code import generate
from dataplane.errors import DataplaneError, ProgramError
from dataplane.p4runtime.device import Device
from dataplane.p4runtime.schema import bind
from dataplane.p4runtime.server import P4RuntimeServer
from dataplane.p4runtime.status import Refused, details
from dataplane.p4runtime.trust import AnyProgram
from dataplane.packet_loop import PacketClock, PacketLoop
from dataplane.ports.port import MemoryPort
from dataplane.v1model.program import load
from p4rt import open_channel, p4info, p4runtime, status
from sdnator.p4_program import find
from sdnator.testing.p4runtime_client import EntryBuilder, delete, insert, modify, program_config
from sdnator.testing.switch_entities import every_entity

PROGRAM = Path(__file__).resolve().parent.parent / "tests" / "dataplane" / "programs" / "features"
"""A program with every feature that the embedded switch has."""
_FRESH_EVERY = 2000
"""Inputs after which a device gets its pipeline anew: entries pile up, and are no leak."""
_SERVICE = "/p4.v1.P4Runtime/"
_CALLS = (
    "Write",
    "Read",
    "SetForwardingPipelineConfig",
    "GetForwardingPipelineConfig",
    "Capabilities",
    "StreamChannel",
)
_TIMEOUT_S = 20.0
_HIGHEST = (1 << 64) - 1
"""The primary's election id, so that no mutated one takes its place for good."""
_MEANT = frozenset(
    ("INVALID_ARGUMENT", "NOT_FOUND", "ALREADY_EXISTS", "PERMISSION_DENIED", "RESOURCE_EXHAUSTED",
     "FAILED_PRECONDITION", "ABORTED", "OUT_OF_RANGE", "UNIMPLEMENTED")
)  # fmt: skip


def _set_request(action: int) -> Any:
    request = p4runtime.SetForwardingPipelineConfigRequest(device_id=1, action=action)
    request.election_id.low = 1
    request.config.CopyFrom(program_config(PROGRAM))
    return request


class AttackedDevice:
    """A device with a primary controller, whose pipeline is set anew now and then."""

    def __init__(self, program: Any = None) -> None:
        self.device = Device(1, clock=lambda: 0, programs=AnyProgram())
        update = p4runtime.MasterArbitrationUpdate(device_id=1)
        update.election_id.low = 1
        self.stream = self.device.open_stream()
        self.device.arbitrate(self.stream, update)
        self._request = _set_request(p4runtime.SetForwardingPipelineConfigRequest.VERIFY_AND_COMMIT)
        if program is not None:
            self._request.config.CopyFrom(program)
        self._inputs = 0

    def refreshed(self) -> Device:
        if self._inputs % _FRESH_EVERY == 0:
            self.device.set_pipeline(self._request)
        self._inputs += 1
        return self.device

    def write(self, data: bytes) -> None:
        """The updates of a WriteRequest, then the same entities read."""
        device, request = self.refreshed(), p4runtime.WriteRequest.FromString(data)
        results = device.write(request)
        if results:
            status.Status.FromString(details(results, "Write"))
        asked = p4runtime.ReadRequest(device_id=1, entities=[update.entity for update in request.updates])
        reading = device.read(asked)
        while reading.page() is not None:
            pass

    def read(self, data: bytes) -> None:
        """A ReadRequest, page by page."""
        reading = self.refreshed().read(p4runtime.ReadRequest.FromString(data))
        while reading.page() is not None:
            pass

    def stream_message(self, data: bytes) -> None:
        """What a controller says on its stream."""
        device, message = self.refreshed(), p4runtime.StreamMessageRequest.FromString(data)
        kind = message.WhichOneof("update")
        if kind == "digest_ack":
            device.acknowledge(self.stream, message.digest_ack)
        elif kind == "packet":
            device.packet_out(self.stream, message.packet)


@cache
def _device() -> AttackedDevice:
    return AttackedDevice()


def _writes() -> tuple[bytes, ...]:
    made = []
    for entity in every_entity(EntryBuilder(program_config(PROGRAM).p4info)):
        for one in (insert, modify, delete):
            request = p4runtime.WriteRequest(device_id=1, updates=[one(entity)])
            request.election_id.low = 1
            made.append(request.SerializeToString())
    return tuple(made)


def _reads() -> tuple[bytes, ...]:
    found = every_entity(EntryBuilder(program_config(PROGRAM).p4info))
    return tuple(p4runtime.ReadRequest(device_id=1, entities=[one]).SerializeToString() for one in found)


def stream_messages() -> tuple[bytes, ...]:
    """Arbitration, a packet-out, an acknowledgement."""
    hello, packet, ack = (p4runtime.StreamMessageRequest() for _ in range(3))
    hello.arbitration.device_id = 1
    hello.arbitration.election_id.low = 7
    packet.packet.payload = bytes(40)
    packet.packet.metadata.add(metadata_id=1, value=b"\x03")
    packet.packet.metadata.add(metadata_id=2, value=b"\x00")
    ack.digest_ack.digest_id = program_config(PROGRAM).p4info.digests[0].preamble.id
    return tuple(each.SerializeToString() for each in (hello, packet, ack))


def _program(data: bytes) -> None:
    """A program that loads is compiled, except by gcc."""
    program = load(data)
    generate(program, layout.make(program))


def _p4info(data: bytes) -> None:
    for program, info in ((_features(), data), (_own(), data)):
        try:
            bind(p4info.P4Info.FromString(info), program)
        except Refused:
            continue


@cache
def _features() -> Any:
    return load(PROGRAM.with_suffix(".json").read_bytes())


@cache
def _own() -> Any:
    return load(find().bmv2_json.read_bytes())


def _p4infos() -> tuple[bytes, ...]:
    configs = (program_config(PROGRAM), program_config(find().bmv2_json.with_suffix("")))
    return tuple(config.p4info.SerializeToString() for config in configs)


def _claim(message: Any) -> None:
    message.election_id.high = message.election_id.low = _HIGHEST


def _claimed(data: bytes) -> bytes:
    request = p4runtime.WriteRequest.FromString(data)
    _claim(request)
    return bytes(request.SerializeToString())


class _LiveServer:
    """An embedded switch with ports and a gRPC server on a Unix socket, and a channel to it."""

    def __init__(self) -> None:
        self._clock = PacketClock(driven=False)
        ports = {number: MemoryPort() for number in (1, 2, 3)}
        self._port = ports[1]
        self.device = Device(1, ports=ports, clock=self._clock.now, programs=AnyProgram())
        folder = tempfile.mkdtemp(prefix="hostile-")
        self._server = P4RuntimeServer(self.device, f"unix:{folder}/socket")
        self._loop = PacketLoop(self.device, ports, self._clock)
        self._loop.start()
        self._server.start()
        atexit.register(self._server.stop)
        channel = open_channel(self._server.address)
        self._calls: dict[str, Any] = {
            name: (channel.unary_stream if name == "Read" else channel.unary_unary)(_SERVICE + name)
            for name in _CALLS[:-1]
        }
        self._stream: Any = channel.stream_stream(_SERVICE + _CALLS[-1])
        hello = p4runtime.StreamMessageRequest()
        hello.arbitration.device_id = 1
        _claim(hello.arbitration)
        self._primary = self._stream(self._held(hello.SerializeToString()))
        next(self._primary)
        config = _set_request(p4runtime.SetForwardingPipelineConfigRequest.VERIFY_AND_COMMIT)
        _claim(config)
        self._config = config.SerializeToString()
        self._inputs = 0

    def _held(self, first: bytes) -> Any:
        yield first
        threading.Event().wait()

    def attack(self, data: bytes) -> None:
        """The first byte chooses the call."""
        if self._inputs % _FRESH_EVERY == 0:
            self._calls["SetForwardingPipelineConfig"](self._config, timeout=_TIMEOUT_S)
        self._inputs += 1
        name, message = _CALLS[data[0] % len(_CALLS) if data else 0], data[1:]
        try:
            if name == "StreamChannel":
                list(self._stream(iter([message]), timeout=_TIMEOUT_S))
            elif name == "Read":
                list(self._calls[name](message, timeout=_TIMEOUT_S))
            else:
                self._calls[name](message, timeout=_TIMEOUT_S)
        except grpc.RpcError as error:
            _judge(error)
        self._port.inject(message[:1500])
        assert not self._loop.failed, "the packet loop has ended"


def _judge(error: Any) -> None:
    """Raises AssertionError for an answer that a defect gives."""
    code, text = error.code().name, error.details() or ""
    batch = code == "UNKNOWN" and any(
        key == "grpc-status-details-bin" for key, _ in error.trailing_metadata()
    )
    assert "Unexpected" not in text, text
    assert code in _MEANT or batch, (code, text)


@cache
def _server() -> _LiveServer:
    return _LiveServer()


def _live(data: bytes) -> None:
    _server().attack(data)


def _live_seeds() -> tuple[bytes, ...]:
    get = p4runtime.GetForwardingPipelineConfigRequest(device_id=1).SerializeToString()
    verify = _set_request(p4runtime.SetForwardingPipelineConfigRequest.VERIFY)
    verify.config.p4_device_config = b'{"pipelines": []}'
    _claim(verify)
    return (
        *(b"\0" + _claimed(one) for one in _writes()),
        *(b"\1" + one for one in _reads()),
        b"\2" + verify.SerializeToString(),
        b"\3" + get,
        b"\4" + p4runtime.CapabilitiesRequest(device_id=1).SerializeToString(),
        *(b"\5" + one for one in stream_messages()),
    )


def _mutate_call(chance: random.Random, seeds: Sequence[bytes]) -> bytes:
    seed = chance.choice(seeds)
    return seed[:1] + mutate_protobuf(chance, (seed[1:],))


def _on_device(call: str) -> Callable[[bytes], object]:
    def decode(data: bytes) -> object:
        return getattr(_device(), call)(data)  # made with the first input, not at import

    return decode


def _frames(data: bytes) -> object:
    pipeline = _device().refreshed().pipeline
    assert pipeline is not None
    return pipeline.switch.process(1 + len(data) % 3, data[:65_535], 5)


_PROGRAMS = tuple(Path(PROGRAM).with_name(f"{name}.json").read_bytes() for name in ("features",))

TARGETS = (
    DecoderTarget("bmv2 json", _program, (ProgramError, DataplaneError), _PROGRAMS, mutate_json),
    DecoderTarget("p4info", _p4info, (DecodeError,), _p4infos(), mutate_protobuf),
    DecoderTarget("p4runtime write", _on_device("write"), (DecodeError, Refused), _writes(), mutate_protobuf),
    DecoderTarget("p4runtime read", _on_device("read"), (DecodeError, Refused), _reads(), mutate_protobuf),
    DecoderTarget(
        "p4runtime stream",
        _on_device("stream_message"),
        (DecodeError, Refused),
        stream_messages(),
        mutate_protobuf,
    ),
    DecoderTarget("p4runtime server", _live, (), _live_seeds(), _mutate_call),
    DecoderTarget("switch frames", _frames, (), tuple(frames())),
)
