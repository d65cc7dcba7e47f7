"""The one thread that moves packets: ports in, switch, ports and controllers out.

A lossless port (a replay's) is read only while the controllers' queues have room and a controller is
primary; otherwise its frames wait.  Other ports are always read, and packet-ins that cannot be queued are
counted.
"""

import select
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from dataplane.compiler.machine import BatchResult, FrameSlices
from dataplane.errors import DataplaneError
from dataplane.p4runtime.device import Device
from dataplane.p4runtime.pipeline import ForwardingPipeline
from dataplane.ports.port import Arrived, NullPort, Port, Wakeup
from dataplane.ports.veth_port import VethPort

_CHUNK = 256
_BLOCK = 4096
"""Most frames of a capture that are processed before others have their turn."""
_IDLE_MS = 100
_PACKET_OUTS = 4096
_STREAM = 8
"""Frames of a round from which on others are expected to follow at once."""
_GATHER_S = 0.001


def _nothing() -> None:
    return


def _machine_us() -> int:
    """µs since the machine was booted; continues during sleep, and is independent of the wall clock."""
    return time.clock_gettime_ns(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)) // 1000


def gathering_s(frames: int, spent_s: float) -> float:
    """How long to leave live ports alone after a round, so that frames of a stream are read together.

    A round costs as much as a hundred frames: read at once, a stream of few thousand frames a second keeps a core
    busy that others need.  Single frames do not wait.

    frames: that the round brought
    spent_s: since the round began
    """
    return max(0.0, _GATHER_S - spent_s) if frames >= _STREAM else 0.0


class ClockError(DataplaneError):
    """The clock's zero is in the future."""


class PacketClock:
    """µs for packets: of the capture where one drives the switch, else since `base_us`.

    base_us: the clock's zero on CLOCK_BOOTTIME, so that a restarted switch continues the previous
        clock; None = now

    Raises ClockError.
    """

    def __init__(self, *, driven: bool, base_us: int | None = None) -> None:
        self._driven = driven
        now = _machine_us()
        self.base_us = now if base_us is None else base_us
        if not 0 <= self.base_us <= now:
            raise ClockError(f"the clock cannot begin at {base_us} µs after boot: it is {now} µs now")
        self._last_us = 0

    def now(self) -> int:
        """The packets' time, µs."""
        return self._last_us if self._driven else _machine_us() - self.base_us

    def advance(self, time_us: int) -> None:
        """Set the time to that of a frame of a capture."""
        self._last_us = time_us


class PacketLoop:
    """Runs a device's ports.

    ports: by port number
    clock: the same as the device's
    on_end: called when the thread has ended, also by a fault
    """

    def __init__(
        self,
        device: Device,
        ports: Mapping[int, Port],
        clock: PacketClock,
        on_end: Callable[[], None] = _nothing,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._device = device
        self._ports = dict(ports)
        self._clock = clock
        self._wakeup = Wakeup()
        self._packet_outs: deque[bytes] = deque()
        self._space = threading.Condition()
        self._stopping = False
        self.turns = 0
        """Rounds made so far."""
        self.failed = False
        """Whether the thread has ended without being stopped."""
        self._on_end = on_end
        self._thread = threading.Thread(target=self._run, name="packets", daemon=True)
        device.on_room = self._wakeup.set
        device.on_packet_out = self._put_packet_out
        device.crowded = self._crowded

    def start(self) -> None:
        """Begin to process packets."""
        self._thread.start()

    def ask(self) -> None:
        """Make a round soon, even without frames."""
        self._wakeup.set()

    def stop(self) -> None:
        """Finish the frames in progress, then close the ports."""
        self._stopping = True
        self._wakeup.set()
        with self._space:
            self._space.notify_all()
        self._thread.join()
        for port in self._ports.values():
            port.close()
        self._wakeup.close()

    def _crowded(self) -> bool:
        return len(self._packet_outs) >= _PACKET_OUTS

    def _put_packet_out(self, payload: bytes) -> None:
        with self._space:
            # the controller's stream is not read while too many wait
            self._space.wait_for(lambda: len(self._packet_outs) < _PACKET_OUTS or self._stopping)
            self._packet_outs.append(payload)
        self._wakeup.set()

    def _run(self) -> None:
        try:
            self._move()
        finally:
            self.failed = not self._stopping
            self._on_end()

    def _move(self) -> None:
        while not self._stopping:
            self.turns += 1
            ready = self._wait()
            began = time.monotonic()
            with self._device.running:
                pipeline = self._device.pipeline
                if pipeline is None:
                    self._discard(ready)
                    continue
                self._send_packet_outs(pipeline)
                frames = sum([self._receive(pipeline, number, self._ports[number]) for number in ready])
                self._device.tick(pipeline, self._clock.now())
            pause_s = gathering_s(frames, time.monotonic() - began)
            if pause_s and not any(self._ports[number].lossless for number in ready):
                time.sleep(pause_s)

    def _wait(self) -> list[int]:
        """Port numbers that have frames and may be read."""
        poll = select.poll()
        poll.register(self._wakeup.fileno(), select.POLLIN)
        waiting, descriptors = [], {}
        room = self._device.room()
        for number, port in self._ports.items():
            readable = not port.lossless or room > 0
            if readable and port.waiting():
                waiting.append(number)
            events = (select.POLLIN if readable else 0) | (select.POLLOUT if port.unsent() else 0)
            descriptor = port.fileno()
            if events and descriptor >= 0:
                poll.register(descriptor, events)
                descriptors[descriptor] = number
        happened = dict(poll.poll(0 if waiting else self._timeout_ms()))
        if self._wakeup.fileno() in happened:
            self._wakeup.clear()
        return self._sort_out(happened, descriptors, waiting)

    def _sort_out(
        self, happened: dict[int, int], descriptors: dict[int, int], waiting: list[int]
    ) -> list[int]:
        for descriptor, number in descriptors.items():
            events = happened.get(descriptor, 0)
            if events & ~select.POLLIN:
                self._ports[number].flush()
            if events & ~select.POLLOUT and number not in waiting:
                waiting.append(number)
        return waiting

    def _timeout_ms(self) -> int:
        pipeline = self._device.pipeline
        due = None if pipeline is None else pipeline.digests.next_due_ns()
        if due is None:
            return _IDLE_MS
        return max(0, min(_IDLE_MS, (due - time.monotonic_ns() + 999_999) // 1_000_000))

    def _discard(self, ready: list[int]) -> None:
        for number in ready:
            port = self._ports[number]
            if not port.lossless:
                count = len(port.receive(_CHUNK))
                self.counts["without_pipeline"] += count
                port.done(bytes(count))

    def _send_packet_outs(self, pipeline: ForwardingPipeline) -> None:
        while self._packet_outs:
            payload = self._packet_outs.popleft()
            result = pipeline.switch.packet_out(payload, self._clock.now())
            self._hand_out(pipeline, result, lossless=True)
            with self._space:
                self._space.notify_all()

    def _receive(self, pipeline: ForwardingPipeline, number: int, port: Port) -> int:
        """Move a port's frames; how many there were."""
        limit = _CHUNK
        if port.lossless:
            limit = min(_BLOCK, self._device.room())
            if not limit:
                return 0
        arrived = port.receive(limit)
        if len(arrived):
            result = self._process(pipeline, number, arrived, lossless=port.lossless)
            self._hand_out(pipeline, result, lossless=port.lossless)
            port.done(result.verdicts)
        return len(arrived)

    def _send_slices(self, outputs: FrameSlices) -> None:
        for number in np.flatnonzero(np.bincount(outputs.ports)).tolist():
            of_port, port = outputs.to(number), self._ports.get(number)
            if isinstance(port, NullPort):
                port.counters.sent += len(of_port)
            elif isinstance(port, VethPort):
                port.send_many(of_port.data, of_port.begins, of_port.ends)
            else:
                self._send(number, of_port.frames())

    def _send(self, number: int, frames: Sequence[bytes]) -> None:
        port = self._ports.get(number)
        if port is None:
            self.counts["no_such_port"] += len(frames)
            return
        for frame in frames:
            port.send(frame)

    def _process(
        self, pipeline: ForwardingPipeline, number: int, arrived: Arrived, *, lossless: bool
    ) -> BatchResult:
        if (block := arrived.block) is not None:
            if lossless:
                self._clock.advance(int(block.times_us[-1]))
            else:
                block = replace(block, times_us=np.full(len(block), self._clock.now()))
            return pipeline.switch.process_block(number, block)
        frames = arrived.frames
        times = arrived.times_us or [self._clock.now()] * len(frames)
        if arrived.times_us:
            self._clock.advance(times[-1])
        return pipeline.switch.process_many(number, frames, times)

    def _hand_out(self, pipeline: ForwardingPipeline, result: BatchResult, *, lossless: bool) -> None:
        if isinstance(result.outputs, FrameSlices):
            self._send_slices(result.outputs)
        else:
            for number, frame in result.outputs:
                self._send(number, (frame,))
        self._device.deliver(pipeline, result, lossless=lossless)
