"""The gRPC face of P4Runtime: a client stub and the registration of a server."""

from collections.abc import Callable
from typing import Any, Protocol

import grpc
import grpc.aio
from google.protobuf.message import DecodeError

from p4rt.messages import p4runtime

_SERVICE = "p4.v1.P4Runtime"
_UNARY = ("Write", "SetForwardingPipelineConfig", "GetForwardingPipelineConfig", "Capabilities")


class P4RuntimeStub:
    """Client side of the P4Runtime service (P4Runtime specification, section 8).

    Every attribute is a gRPC multi-callable of that name: `stub.Write(request, timeout=5)`.
    """

    def __init__(self, channel: grpc.Channel) -> None:
        def unary(name: str) -> Any:
            return channel.unary_unary(
                f"/{_SERVICE}/{name}",
                request_serializer=getattr(p4runtime, f"{name}Request").SerializeToString,
                response_deserializer=getattr(p4runtime, f"{name}Response").FromString,
            )

        self.Write = unary("Write")
        self.SetForwardingPipelineConfig = unary("SetForwardingPipelineConfig")
        self.GetForwardingPipelineConfig = unary("GetForwardingPipelineConfig")
        self.Capabilities = unary("Capabilities")
        self.Read: Any = channel.unary_stream(
            f"/{_SERVICE}/Read",
            request_serializer=p4runtime.ReadRequest.SerializeToString,
            response_deserializer=p4runtime.ReadResponse.FromString,
        )
        self.StreamChannel: Any = channel.stream_stream(
            f"/{_SERVICE}/StreamChannel",
            request_serializer=p4runtime.StreamMessageRequest.SerializeToString,
            response_deserializer=p4runtime.StreamMessageResponse.FromString,
        )


def stream_of_bytes(channel: grpc.Channel) -> Any:
    """StreamChannel whose responses stay serialized: for who reads digest lists without an object a sample."""
    return channel.stream_stream(
        f"/{_SERVICE}/StreamChannel", request_serializer=p4runtime.StreamMessageRequest.SerializeToString
    )


class P4RuntimeServicer(Protocol):
    """What a server must offer: the six calls of the service, by their names on the wire."""

    def Write(self, request: Any, context: grpc.ServicerContext) -> Any: ...  # noqa: N802
    def Read(self, request: Any, context: grpc.ServicerContext) -> Any: ...  # noqa: N802
    def SetForwardingPipelineConfig(self, request: Any, context: grpc.ServicerContext) -> Any: ...  # noqa: N802
    def GetForwardingPipelineConfig(self, request: Any, context: grpc.ServicerContext) -> Any: ...  # noqa: N802
    def Capabilities(self, request: Any, context: grpc.ServicerContext) -> Any: ...  # noqa: N802
    def StreamChannel(self, request_iterator: Any, context: grpc.ServicerContext) -> Any: ...  # noqa: N802


Decode = Callable[[bytes], Any]


def strictly(message: Any) -> Decode:
    """Bytes that are no such message end the call with an exception within gRPC."""
    decode: Decode = message.FromString
    return decode


def or_none(message: Any) -> Decode:
    """Bytes that are no such message are None, and the servicer's to refuse."""

    def decode(data: bytes) -> Any:
        try:
            return message.FromString(data)
        except DecodeError:
            return None

    return decode


def add_p4runtime_servicer(
    servicer: P4RuntimeServicer,
    server: grpc.Server | grpc.aio.Server,
    decoder: Callable[[Any], Decode] = strictly,
) -> None:
    """Register `servicer` for the P4Runtime service of `server`.

    decoder: `strictly` or `or_none`
    """
    handlers = {
        name: grpc.unary_unary_rpc_method_handler(
            getattr(servicer, name),
            request_deserializer=decoder(getattr(p4runtime, f"{name}Request")),
            response_serializer=getattr(p4runtime, f"{name}Response").SerializeToString,
        )
        for name in _UNARY
    }
    handlers["Read"] = grpc.unary_stream_rpc_method_handler(
        servicer.Read,
        request_deserializer=decoder(p4runtime.ReadRequest),
        response_serializer=p4runtime.ReadResponse.SerializeToString,
    )
    handlers["StreamChannel"] = grpc.stream_stream_rpc_method_handler(
        servicer.StreamChannel,
        request_deserializer=decoder(p4runtime.StreamMessageRequest),
        response_serializer=p4runtime.StreamMessageResponse.SerializeToString,
    )
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(_SERVICE, handlers),))
