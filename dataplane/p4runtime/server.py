"""The P4Runtime service of the embedded switch: gRPC in front of a Device.

    packet loop ──► Stream ──► event loop (a thread of its own) ◄──► gRPC
                                   │  ▲
                       small calls │  │ whatever may take long: a big Write, Read, a pipeline
                                   ▼  │
                                  Device

One thread sends and receives everything: with a thread for each call every packet-in would wake three.
"""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import grpc
import grpc.aio
import uvloop

from dataplane.p4runtime import messages, status
from dataplane.p4runtime.client_rights import PACKET_OUT, PIPELINE, TABLES, CertificateRights, Peer
from dataplane.p4runtime.device import MAX_STREAMS, Device
from dataplane.p4runtime.listening import ServerError, ready_to_bind, socket_path
from dataplane.p4runtime.status import Refused
from dataplane.p4runtime.streams import ControllerStream
from p4rt import add_p4runtime_servicer, or_none, p4runtime

__all__ = ["P4RuntimeServer", "ServerError", "Servicer"]

API_VERSION = "1.4.0"
_WORKERS = 8
_MOST_CALLS = 256
_MOST_READS = 8
_MOST_BYTES = 64 << 20
"""Of one message."""
_SMALL_WRITE = 16
"""Updates; more of them would keep packet-ins waiting for a millisecond and longer."""
_NO_MESSAGE = "the request is not a message of p4.v1"
_DETAILS = "grpc-status-details-bin"
_OPTIONS = (
    ("grpc.max_receive_message_length", _MOST_BYTES),
    ("grpc.max_send_message_length", _MOST_BYTES),
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

_T = TypeVar("_T")
_Context = Any  # grpc.aio.ServicerContext, generic in request and response, which we serialize ourselves


class Servicer:
    """The six calls of P4Runtime, for one device.

    pool: for what may take long
    rights: of clients by their certificates; None: everybody who connects may do everything
    """

    def __init__(
        self, device: Device, pool: ThreadPoolExecutor, rights: CertificateRights | None = None
    ) -> None:
        self._device = device
        self._pool = pool
        self._rights = rights
        self.reads_in_progress = 0

    async def Write(self, request: Any, context: _Context) -> Any:  # noqa: N802
        await self._require(request, context, TABLES)
        run = self._at_once if len(request.updates) <= _SMALL_WRITE else self._aside
        try:
            results = await run(self._device.write, request)
        except Refused as error:
            await context.abort(status.grpc_code(error), str(error))
        if results:
            await _abort_batch(context, results, "Write")
        return p4runtime.WriteResponse()

    async def Read(self, request: Any, context: _Context) -> AsyncIterator[Any]:  # noqa: N802
        await self._require(request, context)
        if self.reads_in_progress >= _MOST_READS:
            busy = f"{_MOST_READS} Reads are in progress: try again when one is done"
            await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, busy)
        self.reads_in_progress += 1
        try:
            reading = await self._aside(self._device.read, request)
            # a client that is gone has this generator closed: no further page is made
            while (response := await self._aside(reading.page)) is not None:
                if response.entities:
                    yield response
        except Refused as error:
            await context.abort(status.grpc_code(error), str(error))
        finally:
            self.reads_in_progress -= 1
        if any(reading.results):
            await _abort_batch(context, reading.results, "Read")

    async def SetForwardingPipelineConfig(self, request: Any, context: _Context) -> Any:  # noqa: N802
        await self._require(request, context, PIPELINE)
        try:
            await self._aside(self._device.set_pipeline, request)
        except Refused as error:
            await context.abort(status.grpc_code(error), str(error))
        return p4runtime.SetForwardingPipelineConfigResponse()

    async def GetForwardingPipelineConfig(self, request: Any, context: _Context) -> Any:  # noqa: N802
        await self._require(request, context)
        try:
            return await self._aside(self._device.get_pipeline, request)
        except Refused as error:
            await context.abort(status.grpc_code(error), str(error))

    async def Capabilities(self, request: Any, context: _Context) -> Any:  # noqa: N802
        await self._require(request, context)
        return p4runtime.CapabilitiesResponse(p4runtime_api_version=API_VERSION)

    async def StreamChannel(self, requests: AsyncIterator[Any], context: _Context) -> None:  # noqa: N802
        try:
            if self._rights is not None:
                self._rights.require_stream(context.auth_context())
            stream = self._device.open_stream()
        except Refused as error:
            await context.abort(status.grpc_code(error), str(error))
        peer = None if self._rights is None else context.auth_context()
        listener = asyncio.create_task(self._listen(stream, requests, peer))
        try:
            await stream.send(context.write)
        finally:
            listener.cancel()
            await self._at_once(self._device.close_stream, stream)
        if stream.error is not None:
            await context.abort(status.grpc_code(stream.error), str(stream.error))

    async def _listen(
        self, stream: ControllerStream, requests: AsyncIterator[Any], peer: Peer | None
    ) -> None:
        """Take in what a controller sends, until it stops or breaks the rules of arbitration."""
        try:
            async for request in requests:
                if request is None:
                    raise status.InvalidArgument(_NO_MESSAGE)
                await self._take(stream, request, peer)
        except Refused as error:
            stream.end(error)
        finally:
            stream.end()

    async def _take(self, stream: ControllerStream, request: Any, peer: Peer | None) -> None:
        kind = request.WhichOneof("update")
        if kind == "arbitration":
            if self._rights is not None and peer is not None:
                self._rights.require_claim(peer, request.arbitration.role.name)
            await self._at_once(self._device.arbitrate, stream, request.arbitration)
            return
        try:
            if kind == "packet":
                if self._rights is not None and peer is not None:
                    self._rights.require(peer, PACKET_OUT)
                if self._device.crowded():  # this controller is not read on, and only this one waits
                    await self._aside(self._device.packet_out, stream, request.packet)
                else:
                    self._device.packet_out(stream, request.packet)
            elif kind == "digest_ack":
                await self._at_once(self._device.acknowledge, stream, request.digest_ack)
            else:
                raise status.InvalidArgument(
                    f"stream message {kind or 'without content'}: this target takes none"
                )
        except Refused as error:
            stream.post(messages.stream_error(error, request))

    async def _require(self, request: Any | None, context: _Context, right: str = "") -> None:
        """The request is a message, which gRPC would log a traceback for, and the client may make it."""
        if request is None:
            await context.abort(grpc.StatusCode.INVALID_ARGUMENT, _NO_MESSAGE)
        if self._rights is None:
            return
        try:
            self._rights.require(context.auth_context(), right)
        except Refused as error:
            await context.abort(status.grpc_code(error), str(error))

    async def _at_once(self, call: Callable[..., _T], *arguments: Any) -> _T:
        """In this thread, unless the device is busy with something that takes long."""
        if not self._device.control.acquire(blocking=False):
            return await self._aside(call, *arguments)
        try:
            return call(*arguments)
        finally:
            self._device.control.release()

    async def _aside(self, call: Callable[..., _T], *arguments: Any) -> _T:
        return await asyncio.get_running_loop().run_in_executor(self._pool, call, *arguments)


async def _abort_batch(context: _Context, results: list[Refused | None], what: str) -> None:
    packed = status.details(results, what)
    context.set_trailing_metadata(((_DETAILS, packed),))
    failed = [str(error) for error in results if error is not None]
    await context.abort(
        grpc.StatusCode.UNKNOWN, f"{what}: {len(failed)} of {len(results)} failed, first: {failed[0]}"
    )


class P4RuntimeServer:
    """A gRPC server for one device.

    address: "unix:/path", or "host:port"; port 0 = any, see `address` afterwards
    credentials: for TLS; without, plain text
    rights: of clients by the certificates that these credentials demand; None: all

    Raises ServerError.
    """

    def __init__(
        self,
        device: Device,
        address: str,
        credentials: grpc.ServerCredentials | None = None,
        rights: CertificateRights | None = None,
    ) -> None:
        self._socket = socket_path(address)
        self._turns = 0
        # each stream may hold one up while packet-outs are crowded
        self._pool = ThreadPoolExecutor(MAX_STREAMS + _WORKERS, thread_name_prefix="p4runtime")
        with ready_to_bind(address):
            self.servicer = Servicer(device, self._pool, rights)
            self._server, port = _in_loop(_bound(self.servicer, address, credentials))
        self.address = address if self._socket is not None else f"{address.rpartition(':')[0]}:{port}"

    def start(self) -> None:
        """Begin to serve."""
        _in_loop(self._server.start())

    def stop(self, grace: float = 0.5) -> None:
        """End all calls, at the latest after `grace` seconds."""
        _in_loop(self._server.stop(grace))
        self._pool.shutdown(wait=False, cancel_futures=True)
        if self._socket is not None:
            self._socket.unlink(missing_ok=True)

    @property
    def turns(self) -> int:
        """Rounds of the event loop that were asked for and made."""
        return self._turns

    def ask(self) -> None:
        """Have the event loop make a round."""
        _event_loop().call_soon_threadsafe(self._turn)

    def _turn(self) -> None:
        self._turns += 1


async def _bound(
    servicer: Servicer, address: str, credentials: grpc.ServerCredentials | None
) -> tuple[grpc.aio.Server, int]:
    server = grpc.aio.server(options=_OPTIONS, maximum_concurrent_rpcs=_MOST_CALLS)
    # asked first: the stream's responses are protobuf bytes already
    server.add_generic_rpc_handlers((_stream_handler(servicer),))
    add_p4runtime_servicer(servicer, server, or_none)
    try:
        if credentials is None:
            port = server.add_insecure_port(address)
        else:
            port = server.add_secure_port(address, credentials)
    except RuntimeError as error:
        raise ServerError(f"cannot listen on {address}: {error}; choose another address or port") from error
    return server, port


_loop: asyncio.AbstractEventLoop | None = None
_starting = threading.Lock()


def _in_loop(work: Coroutine[Any, Any, _T]) -> _T:
    """Run in the event loop of this process: gRPC serves several servers from one, and not from several."""
    return asyncio.run_coroutine_threadsafe(work, _event_loop()).result()


def _event_loop() -> asyncio.AbstractEventLoop:
    global _loop  # one for the process, as gRPC has one poller
    with _starting:
        if _loop is None:
            _loop = uvloop.new_event_loop()
            threading.Thread(target=_turn_for_ever, args=(_loop,), name="p4runtime", daemon=True).start()
    return _loop


def _turn_for_ever(loop: asyncio.AbstractEventLoop) -> None:
    loop.run_forever()
    raise RuntimeError("the event loop of P4Runtime has ended")


def _stream_handler(servicer: Servicer) -> grpc.GenericRpcHandler:
    handler = grpc.stream_stream_rpc_method_handler(
        servicer.StreamChannel,
        request_deserializer=or_none(p4runtime.StreamMessageRequest),
        response_serializer=bytes,
    )
    return grpc.method_handlers_generic_handler("p4.v1.P4Runtime", {"StreamChannel": handler})
