"""The switches that the contract suite runs against: one set of calls, whatever is behind it."""

import queue
import threading
import time
from collections import defaultdict
from typing import Any, Protocol

import grpc
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from dataplane.bmv2 import Bmv2
from dataplane.compiler.machine import MachineMaker
from dataplane.p4runtime.trust import AnyProgram
from sdnator.testing.switch_double import SwitchDouble

_WAIT_S = 60.0
_QUIET_S = 0.15


class Target(Protocol):
    """A P4Runtime switch with ports 1, 2 and 3."""

    name: str
    address: str

    def inject(self, port: int, *frames: bytes) -> None: ...
    def sent(self, port: int, count: int) -> list[bytes]: ...
    def quiet(self, port: int) -> bool: ...
    def drain(self) -> None: ...
    def close(self) -> None: ...


class EmbeddedTarget:
    """The product's own switch, in this process."""

    def __init__(self, maker: MachineMaker) -> None:
        self.name = "embedded"
        self._switch = SwitchDouble(programs=AnyProgram(), maker=maker)
        self.address = self._switch.address

    def inject(self, port: int, *frames: bytes) -> None:
        self._switch.memory[port].inject(*frames)

    def sent(self, port: int, count: int) -> list[bytes]:
        outgoing, deadline = self._switch.memory[port].outgoing, time.monotonic() + _WAIT_S
        while len(outgoing) < count and time.monotonic() < deadline:
            time.sleep(0.002)
        return [outgoing.popleft() for _ in range(min(count, len(outgoing)))]

    def quiet(self, port: int) -> bool:
        time.sleep(_QUIET_S)
        return not self._switch.memory[port].outgoing

    def drain(self) -> None:
        for port in self._switch.memory.values():
            port.outgoing.clear()

    def close(self) -> None:
        self._switch.close()


def _packet_messages() -> tuple[type, type]:
    """PacketStreamRequest and PacketStreamResponse of p4.bm: id, device_id, port, packet."""
    described = descriptor_pb2.FileDescriptorProto(
        name="p4/bm/contract.proto", package="p4.bm", syntax="proto3"
    )
    kinds = descriptor_pb2.FieldDescriptorProto
    fields = (("id", kinds.TYPE_UINT64), ("device_id", kinds.TYPE_UINT64), ("port", kinds.TYPE_UINT32))
    for name in ("PacketStreamRequest", "PacketStreamResponse"):
        message = described.message_type.add(name=name)
        for number, (field, kind) in enumerate((*fields, ("packet", kinds.TYPE_BYTES)), 1):
            message.field.add(name=field, number=number, type=kind, label=kinds.LABEL_OPTIONAL)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(described)
    request, response = (
        message_factory.GetMessageClass(pool.FindMessageTypeByName(f"p4.bm.{name}"))
        for name in ("PacketStreamRequest", "PacketStreamResponse")
    )
    return request, response


class Bmv2Target:
    """simple_switch_grpc with frames by gRPC; needs no root."""

    name = "bmv2"

    def __init__(self) -> None:
        self._request, response = _packet_messages()
        self._switch = Bmv2({}, device_id=1, packet_stream=True)
        self.address = self._switch.address
        self._frames: defaultdict[int, queue.SimpleQueue[bytes]] = defaultdict(queue.SimpleQueue)
        self._requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._channel = grpc.insecure_channel(self._switch.packet_address)
        self._stream = self._channel.stream_stream(
            "/p4.bm.DataplaneInterface/PacketStream",
            request_serializer=self._request.SerializeToString,
            response_deserializer=response.FromString,
        )
        self._call: Any = None

    def _open(self) -> None:
        """BMv2 takes packets only some time after its first pipeline was set."""
        deadline = time.monotonic() + _WAIT_S
        while time.monotonic() < deadline:
            self._requests = queue.SimpleQueue()
            self._call = self._stream(iter(self._requests.get, None), wait_for_ready=True)
            time.sleep(_QUIET_S)
            if not self._call.done():
                threading.Thread(target=self._receive, args=(self._call,), daemon=True).start()
                return
            self._requests.put(None)

    def _receive(self, call: Any) -> None:
        try:
            for response in call:
                self._frames[response.port].put(response.packet)
        except grpc.RpcError:
            return

    def inject(self, port: int, *frames: bytes) -> None:
        if self._call is None:
            self._open()
        for frame in frames:
            self._requests.put(self._request(device_id=1, port=port, packet=frame))

    def sent(self, port: int, count: int) -> list[bytes]:
        frames = []
        try:
            while len(frames) < count:
                frames.append(self._frames[port].get(timeout=_WAIT_S))
        except queue.Empty:
            pass
        return frames

    def quiet(self, port: int) -> bool:
        time.sleep(_QUIET_S)
        return self._frames[port].empty()

    def drain(self) -> None:
        self._frames.clear()

    def close(self) -> None:
        self._requests.put(None)
        if self._call is not None:
            self._call.cancel()
        self._channel.close()
        self._switch.close()
