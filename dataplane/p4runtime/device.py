"""One P4Runtime device: who controls it, which pipeline is in force, what its packets led to.

    gRPC threads ── write, read, set_pipeline, arbitrate ──► Device ◄── deliver, tick ── packet loop
                                                              │
                      arbitration · pipeline (+ saved one) · a packet queue per role

Control operations are serialised by `control`; `running` is held while packets are in the pipeline, so
that a pipeline is never replaced under them.
"""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from dataplane.compiler.c_machine import CMachine
from dataplane.compiler.machine import BatchResult, MachineMaker
from dataplane.p4runtime import messages, pipeline_config
from dataplane.p4runtime.arbitration import DEFAULT_ROLE, Arbitration, ArbitrationUpdate
from dataplane.p4runtime.pipeline import ForwardingPipeline, verify
from dataplane.p4runtime.reads import Reader
from dataplane.p4runtime.status import (
    Aborted,
    Denied,
    Exhausted,
    InvalidArgument,
    MissingEntity,
    Precondition,
    Refused,
)
from dataplane.p4runtime.streams import ControllerStream, PacketQueue
from dataplane.p4runtime.trust import TrustedPrograms
from dataplane.p4runtime.writes import Writer
from dataplane.v1model.tables import Table, TableEntry
from p4rt import p4runtime

MAX_STREAMS = 16
MOST_UPDATES = 1 << 17
"""Of one Write."""
MOST_CELLS_WRITTEN = 1 << 20
"""Cells of arrays that one Write may set: an update without index sets them all."""
_IDLE_CHECK_US = 100_000


class Device:
    """A device without ports: packet_loop.py brings it frames.

    device_id: 64 bits, the controller must name it
    cpu_port: number of the port that packet-ins leave by
    maker: see Switch
    ports: the ports that exist; None = all
    queue: packet-ins and digest lists that may wait for each role's primary
    clock: the packets' clock, µs
    programs: those that may be loaded; None = the product's own
    roles: that controllers may claim beside the default role
    prepared: a pipeline without entries, for the first configuration if that has the same program
    """

    def __init__(
        self,
        device_id: int,
        *,
        cpu_port: int = 510,
        maker: MachineMaker = CMachine,
        queue: int = 4096,
        ports: Iterable[int] | None = None,
        clock: Callable[[], int],
        programs: TrustedPrograms | None = None,
        roles: Iterable[str] = (),
        prepared: ForwardingPipeline | None = None,
    ) -> None:
        self.device_id = device_id
        self.control = threading.RLock()
        self.running = threading.Lock()
        self.pipeline: ForwardingPipeline | None = None
        self.counts: Counter[str] = Counter()
        self.on_room: Callable[[], None] = _nothing
        self.on_packet_out: Callable[[bytes], None] = _nothing_with
        self.crowded: Callable[[], bool] = _never
        """Whether a packet-out would have to wait for others."""
        self._cpu_port, self._maker, self._capacity, self._clock = cpu_port, maker, queue, clock
        self._ports = None if ports is None else tuple(ports)
        self._programs = TrustedPrograms() if programs is None else programs
        self._roles = {DEFAULT_ROLE, *roles}
        self._saved: ForwardingPipeline | None = None
        self._prepared = prepared
        self._arbitration = Arbitration()
        self._streams: dict[int, ControllerStream] = {}
        self._next_stream = 0
        self._queues: dict[str, PacketQueue] = {}
        self._idle_checked = 0
        self._out_of_range = 0

    def check_id(self, device_id: int) -> None:
        """Raises Missing for another device's id."""
        if device_id != self.device_id:
            raise MissingEntity(f"device {device_id} is not here; this is device {self.device_id}")

    # -- streams --------------------------------------------------------------------------------------

    def open_stream(self) -> ControllerStream:
        """A controller has opened a StreamChannel; to be called by one thread only.  Raises Exhausted."""
        # without `control`, which is held while a program compiles: nobody would close the stream of a client
        # that gave up meanwhile
        if len(self._streams) >= MAX_STREAMS:
            raise Exhausted(f"{MAX_STREAMS} streams are open; close one first")
        self._next_stream += 1
        stream = ControllerStream(self._next_stream)
        self._streams[stream.number] = stream
        return stream

    def close_stream(self, stream: ControllerStream) -> None:
        """The stream is over; its role may be without a primary now."""
        self._streams.pop(stream.number, None)
        with self.control:
            stream.queue = None
            self._notify(self._arbitration.leave(stream.number))
            self._assign_queues()

    def arbitrate(self, stream: ControllerStream, update: Any) -> None:
        """A MasterArbitrationUpdate; one of a stream that is closed is ignored.  Raises what ends the stream."""
        self.check_device(stream, update.device_id)
        if update.role.HasField("config"):
            raise InvalidArgument(
                "role configurations are not agreed upon with this target: leave role.config unset"
            )
        if update.role.name not in self._roles:
            raise Denied(
                f"role {update.role.name[:80]!r} is not configured on this switch: use the default role, or start it"
                " with --role NAME"
            )
        election_id = messages.number(update.election_id) if update.HasField("election_id") else None
        with self.control:
            if stream.number not in self._streams:
                return
            before = self._arbitration.primary(update.role.name)
            notices = self._arbitration.update(stream.number, update.role.name, election_id)
            self._assign_queues()
            if self._arbitration.primary(update.role.name) != before and self.pipeline is not None:
                self.pipeline.digests.forget_sent()
            self._notify(notices)

    def check_device(self, stream: ControllerStream, device_id: int) -> None:
        """Raises Missing, or Precondition where the stream spoke of this device before."""
        if device_id != self.device_id and self._arbitration.role_of(stream.number) is not None:
            raise Precondition(f"this stream belongs to device {self.device_id}")
        self.check_id(device_id)

    def _notify(self, notices: Iterable[ArbitrationUpdate]) -> None:
        for notice in notices:
            stream = self._streams.get(notice.client)
            if stream is not None:
                stream.post(messages.arbitration(self.device_id, notice))

    def _assign_queues(self) -> None:
        primaries = set(self._arbitration.primaries())
        for stream in list(self._streams.values()):
            role = self._arbitration.role_of(stream.number)
            if role is None or stream.number not in primaries:
                stream.queue = None
                continue
            if role not in self._queues:
                self._queues[role] = PacketQueue(self._capacity, self._room)
            queue = self._queues[role]
            queue.reader = stream
            stream.queue = queue
            stream.wake()
        for queue in self._queues.values():
            if queue.reader is not None and queue.reader.queue is not queue:
                queue.reader = None
        self._room()

    def _room(self) -> None:
        self.on_room()

    # -- control --------------------------------------------------------------------------------------

    def write(self, request: Any) -> list[Refused | None]:
        """A WriteRequest; one result per update, or an empty list where all succeeded.  Raises Refused."""
        self.check_id(request.device_id)
        with self.control:
            self._arbitration.check(request.role, messages.number(request.election_id))
            if len(request.updates) > MOST_UPDATES:
                raise Exhausted(
                    f"the Write has {len(request.updates)} updates; at most {MOST_UPDATES} in one call"
                )
            return Writer(self._addressed(), MOST_CELLS_WRITTEN).apply(request.updates, request.atomicity)

    def read(self, request: Any) -> "PagedRead":
        """Begin to answer a ReadRequest.  Raises Refused."""
        self.check_id(request.device_id)
        with self.control:
            reader = Reader(self._addressed())
            reader.check(request.entities)
            return PagedRead(self, reader, request.entities)

    def holds(self, pipeline: ForwardingPipeline) -> bool:
        """Whether it is in force, or saved."""
        return pipeline is self.pipeline or pipeline is self._saved

    def _addressed(self) -> ForwardingPipeline:
        pipeline = self._saved or self.pipeline
        if pipeline is None:
            raise Precondition("no pipeline is set: send SetForwardingPipelineConfig first")
        return pipeline

    def set_pipeline(self, request: Any) -> None:
        """A SetForwardingPipelineConfigRequest.  Raises Refused."""
        self.check_id(request.device_id)
        with self.control:
            self._arbitration.check(request.role, messages.number(request.election_id))
            if request.HasField("config"):
                self._programs.check(request.config)
            plan = pipeline_config.plan(request, self.pipeline, self._saved, self._make)
            self._saved = plan.saved
            if plan.active is not self.pipeline:
                self._replace(plan.active)

    def _make(self, config: Any) -> ForwardingPipeline:
        pipeline, self._prepared = self._prepared, None
        if pipeline is not None and not pipeline.take(config):
            pipeline.close()
            pipeline = None
        if pipeline is None:
            pipeline = ForwardingPipeline(
                verify(config), cpu_port=self._cpu_port, maker=self._maker, clock=self._clock
            )
        pipeline.switch.set_ports(self._ports)
        return pipeline

    def _replace(self, pipeline: ForwardingPipeline | None) -> None:
        with self.running:
            old, self.pipeline = self.pipeline, pipeline
            for queue in self._queues.values():
                self.counts["packet_in_dropped"] += queue.clear()
        if old is not None:
            old.close()
        self._room()

    def close(self) -> None:
        """Free the pipelines; no packets may come any more."""
        with self.control, self.running:
            for pipeline in (self.pipeline, self._saved, self._prepared):
                if pipeline is not None:
                    pipeline.close()
            self.pipeline = self._saved = self._prepared = None

    def out_of_range(self) -> int:
        """Accesses beyond the end of arrays by the program in force; as known last while a control operation runs."""
        if self.control.acquire(blocking=False):
            try:
                pipeline = self.pipeline
                self._out_of_range = 0 if pipeline is None else sum(pipeline.switch.out_of_range().values())
            finally:
                self.control.release()
        return self._out_of_range

    def get_pipeline(self, request: Any) -> Any:
        """The response to a GetForwardingPipelineConfigRequest.  Raises Missing."""
        self.check_id(request.device_id)
        with self.control:
            pipeline = self._saved or self.pipeline
            return pipeline_config.answer(request, None if pipeline is None else pipeline.config)

    # -- packets --------------------------------------------------------------------------------------

    def packet_out(self, stream: ControllerStream, packet: Any) -> None:
        """A PacketOut of a controller.  Raises Refused."""
        if not self._arbitration.is_primary(stream.number):
            raise Denied("only a primary may send packets")
        pipeline = self.pipeline
        if pipeline is None:
            raise Precondition("no pipeline is set")
        self.on_packet_out(pipeline.packet_out.decode(packet))

    def acknowledge(self, stream: ControllerStream, ack: Any) -> None:
        """A DigestListAck of a controller.  Raises Refused."""
        with self.control:
            if not self._arbitration.is_primary(stream.number):
                raise Denied("only a primary may acknowledge digests")
            if self.pipeline is None:
                raise Precondition("no pipeline is set")
            self.pipeline.digests.acknowledge(ack.digest_id, ack.list_id)

    def room(self) -> int:
        """Packet-ins that can be taken without loss: 0 without a pipeline, a primary, or space."""
        readers = [queue for queue in list(self._queues.values()) if queue.reader is not None]
        if self.pipeline is None or not readers:
            return 0
        return min(queue.room() for queue in readers)

    def deliver(self, pipeline: ForwardingPipeline, result: BatchResult, *, lossless: bool) -> None:
        """Queue the packet-ins and digests of processed frames; what has no taker is counted."""
        ready: list[bytes] = []
        if result.packet_ins:
            ready = self._encoded(pipeline, result.packet_ins)
            self.counts["packet_in"] += len(ready)
        if result.digests:
            ready += pipeline.digests.add(result.digests, time.monotonic_ns())
        for name, samples in result.samples.items():
            ready += pipeline.digests.add_samples(name, samples, time.monotonic_ns())
        if ready:
            self._put(ready, lossless=lossless)

    def _encoded(self, pipeline: ForwardingPipeline, frames: list[bytes]) -> list[bytes]:
        encode, shortest = pipeline.packet_in.encode, pipeline.packet_in.header_bytes
        whole = [frame for frame in frames if len(frame) >= shortest]
        # a program can send anything to the CPU port, also less than its own header
        self.counts["packet_in_malformed"] += len(frames) - len(whole)
        return [encode(frame) for frame in whole]

    def _put(self, ready: list[bytes], *, lossless: bool) -> None:
        queues = [queue for queue in list(self._queues.values()) if queue.reader is not None]
        if not queues and lossless and DEFAULT_ROLE in self._queues:
            # the primary left while its frames were in the pipeline: the next one gets them
            queues = [self._queues[DEFAULT_ROLE]]
        if not queues:
            self.counts["packet_in_dropped"] += len(ready)
        for queue in queues:
            self.counts["packet_in_dropped"] += queue.put(ready, lossless=lossless)

    def tick(self, pipeline: ForwardingPipeline, now_us: int) -> None:
        """Send digest lists that are due, and look for idle entries every 0.1 s of the packets' clock."""
        due = pipeline.digests.due(time.monotonic_ns())
        if due:
            self._put(due, lossless=True)
        if pipeline.tables.has_idle_timeouts and abs(now_us - self._idle_checked) >= _IDLE_CHECK_US:
            self._idle_checked = now_us
            self._report_idle(pipeline, pipeline.switch.expired(now_us))

    def _report_idle(self, pipeline: ForwardingPipeline, expired: list[tuple[Table, TableEntry]]) -> None:
        if expired:
            message = p4runtime.StreamMessageResponse()
            notification = message.idle_timeout_notification
            notification.timestamp = time.time_ns()
            for table, entry in expired:
                pipeline.tables.codec_of(table).write_key(entry, notification.table_entry.add())
            self._put([message.SerializeToString()], lossless=False)


class PagedRead:
    """A Read in progress: as many calls of `page` as it takes, with whatever else happens in between."""

    def __init__(self, device: Device, reader: Reader, filters: Any) -> None:
        self.results: list[Refused | None] = []
        """One per filter when the last page has been taken."""
        self._device, self._reader = device, reader
        self._pages = reader.pages(filters, self.results)

    def page(self) -> Any | None:
        """The next ReadResponse, which may be empty; None = that was all.  Raises Refused."""
        with self._device.control:
            if not self._device.holds(self._reader.pipeline):
                raise Aborted("the pipeline was replaced while it was read: read again")
            return next(self._pages, None)


def _nothing() -> None:
    return


def _nothing_with(_: bytes) -> None:
    return


def _never() -> bool:
    return False
