"""The P4Runtime service of the embedded switch: gRPC in front of a Device."""

import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import grpc

from dataplane import messages, status
from dataplane.device import MAX_STREAMS, Device
from dataplane.errors import DataplaneError
from dataplane.status import Refused
from dataplane.streams import Stream
from p4rt import add_p4runtime_servicer, p4runtime

API_VERSION = "1.4.0"
_UNARY_WORKERS = 8
_DETAILS = "grpc-status-details-bin"
_OPTIONS = (
    ("grpc.max_receive_message_length", 256 << 20),
    ("grpc.max_send_message_length", 256 << 20),
    # one p4.v1.Error per update of a batch travels as metadata
    ("grpc.max_metadata_size", 64 << 20),
    ("grpc.absolute_max_metadata_size", 64 << 20),
    ("grpc.so_reuseport", 0),
    # a controller behind a cut connection stops being primary after some seconds
    ("grpc.keepalive_time_ms", 5_000),
    ("grpc.keepalive_timeout_ms", 3_000),
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.max_pings_without_data", 0),
    # and controllers may ask as often themselves
    ("grpc.http2.min_ping_interval_without_data_ms", 1_000),
    ("grpc.http2.min_recv_ping_interval_without_data_ms", 1_000),
    ("grpc.http2.max_ping_strikes", 0),
)


class ServerError(DataplaneError):
    """The server cannot listen where it was told to."""


class Servicer:
    """The six calls of P4Runtime, for one device."""

    def __init__(self, device: Device) -> None:
        self._device = device

    def Write(self, request: Any, context: grpc.ServicerContext) -> Any:  # noqa: N802
        try:
            results = self._device.write(request)
        except Refused as error:
            context.abort(status.grpc_code(error), str(error))
        if results:
            _abort_batch(context, results, "Write")
        return p4runtime.WriteResponse()

    def Read(self, request: Any, context: grpc.ServicerContext) -> Iterator[Any]:  # noqa: N802
        try:
            responses, results = self._device.read(request)
        except Refused as error:
            context.abort(status.grpc_code(error), str(error))
        yield from responses
        if results:
            _abort_batch(context, results, "Read")

    def SetForwardingPipelineConfig(self, request: Any, context: grpc.ServicerContext) -> Any:  # noqa: N802
        try:
            self._device.set_pipeline(request)
        except Refused as error:
            context.abort(status.grpc_code(error), str(error))
        return p4runtime.SetForwardingPipelineConfigResponse()

    def GetForwardingPipelineConfig(self, request: Any, context: grpc.ServicerContext) -> Any:  # noqa: N802
        try:
            return self._device.get_pipeline(request)
        except Refused as error:
            context.abort(status.grpc_code(error), str(error))

    def Capabilities(self, request: Any, context: grpc.ServicerContext) -> Any:  # noqa: N802, ARG002
        return p4runtime.CapabilitiesResponse(p4runtime_api_version=API_VERSION)

    def StreamChannel(self, request_iterator: Any, context: grpc.ServicerContext) -> Iterator[bytes]:  # noqa: N802
        try:
            stream = self._device.open_stream()
        except Refused as error:
            context.abort(status.grpc_code(error), str(error))
        try:
            if not context.add_callback(stream.end):
                return
            reader = threading.Thread(target=self._listen, args=(stream, request_iterator), daemon=True)
            reader.start()
            yield from stream.messages()
        finally:
            self._device.close_stream(stream)
        if stream.error is not None:
            context.abort(status.grpc_code(stream.error), str(stream.error))

    def _listen(self, stream: Stream, requests: Any) -> None:
        """Take in what a controller sends, until it stops or breaks the rules of arbitration."""
        try:
            for request in requests:
                self._take(stream, request)
        except Refused as error:
            stream.end(error)
        except grpc.RpcError:
            stream.end()
        else:
            stream.end()

    def _take(self, stream: Stream, request: Any) -> None:
        kind = request.WhichOneof("update")
        if kind == "arbitration":
            self._device.arbitrate(stream, request.arbitration)
            return
        try:
            if kind == "packet":
                self._device.packet_out(stream, request.packet)
            elif kind == "digest_ack":
                self._device.acknowledge(stream, request.digest_ack)
            else:
                raise status.InvalidArgument(
                    f"stream message {kind or 'without content'}: this target takes none"
                )
        except Refused as error:
            stream.post(messages.stream_error(error, request))


def _abort_batch(context: grpc.ServicerContext, results: list[Refused | None], what: str) -> None:
    packed = status.details(results, what)
    context.set_trailing_metadata(((_DETAILS, packed),))
    failed = [str(error) for error in results if error is not None]
    context.abort(
        grpc.StatusCode.UNKNOWN, f"{what}: {len(failed)} of {len(results)} failed, first: {failed[0]}"
    )


class P4RuntimeServer:
    """A gRPC server for one device.

    address: "host:port"; port 0 = any, see `address` afterwards
    credentials: for TLS; without, plain text

    Raises ServerError.
    """

    def __init__(
        self, device: Device, address: str, credentials: grpc.ServerCredentials | None = None
    ) -> None:
        _check(address)
        self._pool = ThreadPoolExecutor(MAX_STREAMS + _UNARY_WORKERS, thread_name_prefix="p4runtime")
        self._server = grpc.server(self._pool, options=_OPTIONS)
        servicer = Servicer(device)
        # asked first: the stream's responses are protobuf bytes already
        self._server.add_generic_rpc_handlers((_stream_handler(servicer),))
        add_p4runtime_servicer(servicer, self._server)
        try:
            if credentials is None:
                port = self._server.add_insecure_port(address)
            else:
                port = self._server.add_secure_port(address, credentials)
        except RuntimeError as error:
            raise ServerError(
                f"cannot listen on {address}: {error}; choose another address or port"
            ) from error
        self.address = f"{address.rpartition(':')[0]}:{port}"

    def start(self) -> None:
        """Begin to serve."""
        self._server.start()

    def stop(self, grace: float = 0.5) -> None:
        """End all calls, at the latest after `grace` seconds."""
        self._server.stop(grace).wait()
        self._pool.shutdown(wait=False, cancel_futures=True)


def _check(address: str) -> None:
    """Try the address first: gRPC would write lines of its own about a failure.  Raises ServerError."""
    host, _, port = address.rpartition(":")
    try:
        family, kind, _, _, where = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)[
            0
        ]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(where)
    except (OSError, ValueError, OverflowError) as error:
        cause = getattr(error, "strerror", None) or error
        raise ServerError(f"cannot listen on {address}: {cause}; choose another HOST:PORT") from error


def _stream_handler(servicer: Servicer) -> grpc.GenericRpcHandler:
    handler = grpc.stream_stream_rpc_method_handler(
        servicer.StreamChannel,
        request_deserializer=p4runtime.StreamMessageRequest.FromString,
        response_serializer=bytes,
    )
    return grpc.method_handlers_generic_handler("p4.v1.P4Runtime", {"StreamChannel": handler})
