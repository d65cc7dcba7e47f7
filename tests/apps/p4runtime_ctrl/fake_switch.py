"""A P4Runtime server that stores what it is told and sends what a test tells it to; no packets, no P4.

Plain on purpose: what it checks is the little that the controller's tests rely on.  It follows BMv2
in its answers: duplicate election id ends the stream, backups get ALREADY_EXISTS, a failed Write is
UNKNOWN with one `p4.Error` per update.
"""

import queue
import shutil
import tempfile
import threading
import time
from concurrent import futures
from contextlib import suppress
from dataclasses import dataclass, field

import grpc
from google.rpc import code_pb2

from apps.p4runtime_ctrl.state.desired_state import entry_key
from p4rt import add_p4runtime_servicer, p4runtime, status

_DETAILS = "grpc-status-details-bin"


@dataclass
class Stream:
    """One controller's stream."""

    election_id: int
    outgoing: queue.Queue = field(default_factory=queue.Queue)


class FakeSwitch:
    """`with FakeSwitch() as switch:` serves on `switch.address`; `restart()` forgets everything."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.streams: list[Stream] = []
        self.writes: list[list[str]] = []
        self.full_tables: set[int] = set()
        self.hide_details = False
        self.forget()
        self._folder = tempfile.mkdtemp(prefix="fake-switch-")
        self._server = None

    def forget(self) -> None:
        """As after a restart: no program, no entries."""
        self.config = None
        self.programs = 0
        self.entries = {}
        self.defaults = {}
        self.copies = {}
        self.groups = {}
        self.digests = {}

    # -- life ---------------------------------------------------------------------------------

    def __enter__(self) -> "FakeSwitch":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        shutil.rmtree(self._folder)

    def start(self) -> None:
        self._server = grpc.server(futures.ThreadPoolExecutor(16), options=[("grpc.so_reuseport", 0)])
        add_p4runtime_servicer(self, self._server)
        deadline = time.monotonic() + 60
        while True:
            try:
                self._server.add_insecure_port(self.address)
                break
            except RuntimeError:  # the one before may not have let the port go yet
                assert time.monotonic() < deadline
                time.sleep(0.05)
        self._server.start()

    def stop(self) -> None:
        with self.lock:
            for stream in self.streams:
                stream.outgoing.put(None)
        self._server.stop(grace=0).wait(60)

    def restart(self) -> None:
        self.stop()
        self.forget()
        self.start()

    @property
    def address(self) -> str:
        return f"unix:{self._folder}/socket"

    def primary(self) -> Stream | None:
        with self.lock:
            return max(self.streams, key=lambda stream: stream.election_id, default=None)

    def send_packets(self, packets: list) -> None:
        for packet in packets:
            self.primary().outgoing.put(p4runtime.StreamMessageResponse(packet=packet))

    def send_idle(self, entries: list) -> None:
        note = p4runtime.IdleTimeoutNotification(table_entry=entries)
        self.primary().outgoing.put(p4runtime.StreamMessageResponse(idle_timeout_notification=note))

    # -- the service --------------------------------------------------------------------------

    def StreamChannel(self, requests, context):
        first = next(requests).arbitration
        stream = Stream(_number(first.election_id))
        with self.lock:
            if any(other.election_id == stream.election_id for other in self.streams):
                context.abort(grpc.StatusCode.INVALID_ARGUMENT, "election id is in use")
            self.streams.append(stream)
            self._arbitrate()
        context.add_callback(lambda: stream.outgoing.put(None))
        try:
            while (message := stream.outgoing.get()) is not None:
                yield message
        finally:
            with self.lock, suppress(ValueError):
                self.streams.remove(stream)
                self._arbitrate()

    def _arbitrate(self) -> None:
        best = self.primary()
        for stream in self.streams:
            reply = p4runtime.StreamMessageResponse()
            reply.arbitration.election_id.CopyFrom(_uint128(best.election_id))
            reply.arbitration.status.code = 0 if stream is best else code_pb2.ALREADY_EXISTS
            stream.outgoing.put(reply)

    def Write(self, request, context):
        with self.lock:
            best = self.primary()
            if best is None or _number(request.election_id) != best.election_id:
                context.abort(grpc.StatusCode.PERMISSION_DENIED, "not primary")
            errors = [self._update(update) for update in request.updates]
        self.writes.append([_shown(update) for update in request.updates])
        if any(error.canonical_code for error in errors):
            self._fail(context, errors)
        return p4runtime.WriteResponse()

    def _fail(self, context, errors):
        if not self.hide_details or len(errors) == 1:
            found = status.Status(code=code_pb2.UNKNOWN)
            for error in errors:
                found.details.add().Pack(error)
            context.set_trailing_metadata(((_DETAILS, found.SerializeToString()),))
        context.abort(grpc.StatusCode.UNKNOWN, "some updates failed")

    def _update(self, update):
        if update.entity.WhichOneof("entity") == "packet_replication_engine_entry":
            replication = update.entity.packet_replication_engine_entry
            if replication.WhichOneof("type") == "multicast_group_entry":
                group = replication.multicast_group_entry
                return _store(self.groups, group.multicast_group_id, group, update.type)
            session = replication.clone_session_entry
            return _store(self.copies, session.session_id, session, update.type)
        if update.entity.WhichOneof("entity") == "digest_entry":
            digest = update.entity.digest_entry
            return _store(self.digests, digest.digest_id, digest, update.type)
        entry = update.entity.table_entry
        if self.config is None:
            return p4runtime.Error(canonical_code=code_pb2.FAILED_PRECONDITION, message="no program")
        if entry.is_default_action:
            self.defaults[entry.table_id] = _copy(entry)
            return p4runtime.Error()
        if entry.table_id in self.full_tables and update.type == p4runtime.Update.INSERT:
            return p4runtime.Error(canonical_code=code_pb2.RESOURCE_EXHAUSTED, message="table is full")
        return _store(self.entries, entry_key(entry), entry, update.type)

    def Read(self, request, _context):
        with self.lock:
            reply = p4runtime.ReadResponse()
            for entity in request.entities:
                wanted = entity.table_entry
                if wanted.is_default_action:
                    found = [entry for each, entry in self.defaults.items() if each == wanted.table_id]
                else:
                    found = [e for e in self.entries.values() if wanted.table_id in (0, e.table_id)]
                for entry in found:
                    copied = reply.entities.add().table_entry
                    copied.CopyFrom(entry)
                    if wanted.HasField("counter_data"):
                        copied.counter_data.packet_count = 7
                        copied.counter_data.byte_count = 700
        yield reply

    def SetForwardingPipelineConfig(self, request, _context):
        with self.lock:
            self.forget()
            self.config = request.config
            self.programs += 1
        return p4runtime.SetForwardingPipelineConfigResponse()

    def GetForwardingPipelineConfig(self, _request, context):
        if self.config is None:
            context.abort(grpc.StatusCode.FAILED_PRECONDITION, "no program")
        reply = p4runtime.GetForwardingPipelineConfigResponse()
        reply.config.cookie.CopyFrom(self.config.cookie)
        return reply

    def Capabilities(self, _request, _context):
        return p4runtime.CapabilitiesResponse(p4runtime_api_version="1.4.0")


def _store(store, key, value, kind):
    exists = key in store
    if kind == p4runtime.Update.INSERT and exists:
        return p4runtime.Error(canonical_code=code_pb2.ALREADY_EXISTS, message="it exists")
    if kind != p4runtime.Update.INSERT and not exists:
        return p4runtime.Error(canonical_code=code_pb2.NOT_FOUND, message="there is no such entry")
    if kind == p4runtime.Update.DELETE:
        del store[key]
    else:
        store[key] = _copy(value)
    return p4runtime.Error()


def _copy(message):
    copied = type(message)()
    copied.CopyFrom(message)
    return copied


def _shown(update) -> str:
    kind = {1: "insert", 2: "modify", 3: "delete"}[update.type]
    return f"{kind} {update.entity.table_entry.table_id}"


def _number(election_id) -> int:
    return election_id.high << 64 | election_id.low


def _uint128(number: int):
    return p4runtime.Uint128(high=number >> 64, low=number & (1 << 64) - 1)
