"""Messages of a switch → DUE items: the hot path.

One item for each wanted key, from one batch of the stream, in its order.  `write` blocks while consumers of
reliable keys are behind; then the stream is not read, and gRPC's flow control stops the switch.
"""

from collections import deque
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from apps.p4runtime_ctrl.southbound.capture_times import CaptureTimes
from apps.p4runtime_ctrl.southbound.counts_in import CountReader
from apps.p4runtime_ctrl.southbound.digest_in import DigestReader
from apps.p4runtime_ctrl.southbound.loss_tracker import LossTracker, Source
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.packet_in import PacketInBatch, PacketReader
from apps.p4runtime_ctrl.southbound.sequence_merge import PacketRows, SequenceMerger
from apps.p4runtime_ctrl.telemetry.coverage import FALLBACK
from apps.p4runtime_ctrl.telemetry.demand import APP, Demand, Kind, key_of
from apps.packets import read_frames

Write = Callable[[str, Any, int], object]
"""Key, value and event time (ns) of an item to be published at once."""

_SECOND_US: Final = 1_000_000


class PacketPublisher:
    """Publishes packets and reports of the switch `name` through `write`.

    `by_digest`: record batches come from digests, else from copied frames.  `times`: of a capture, in place of the
    switch's clock.
    """

    def __init__(
        self,
        name: str,
        program: ProgramInfo,
        base_us: int,
        write: Write,
        *,
        by_digest: bool = False,
        times: CaptureTimes | None = None,
    ) -> None:
        self.progress = LossTracker()
        self._name = name
        self._write = write
        self._by_digest = by_digest
        self._packets = PacketReader(program, base_us, self.progress, times)
        self._digests = DigestReader(program, base_us, self.progress, times)
        self._counts = CountReader(program, base_us, self.progress)
        self.answers = 0
        """Answers about counting cells."""
        self.counts_reported = 0
        """Differences that the switch reported when their window was over."""
        self._routes: dict[Kind, list[tuple[str, int]]] = {}
        self._copied = True
        """Frames that digests do not cover are copied."""
        self._unison = SequenceMerger()
        self._waited = 0
        self._handovers: deque[int | None] = deque()
        """The highest number of the controller before, or None: another one has the switch."""

    @property
    def fell_back(self) -> int:
        """Records made from copied frames because digests do not cover them."""
        return self._unison.copies

    @property
    def skipped(self) -> int:
        """Frames missing from the records because they came too late, or not at all."""
        return self._unison.skipped

    @property
    def second(self) -> int:
        """Capture time of the newest frame seen, in seconds."""
        return self.progress.time_us // _SECOND_US

    def route(self, demand: Demand) -> None:
        """Publish according to this demand from now on."""
        self._routes = {
            kind: [(key_of(kind, self._name, which), bit) for which, bit in routes.items()]
            for kind, routes in demand.routes.items()
        }
        bits = {request.bit for request in demand.requests}
        self._copied = all(each.bit in bits for each in FALLBACK)
        expected: set[Source] = set()
        for request in demand.requests:
            expected |= {"packet"} if request.copy else set()
            expected |= {"digest"} if request.digest else set()
        self.progress.expected = frozenset(expected)

    def packets(self, messages: list[Any]) -> None:
        """Publish packet-ins, in the order of their stream."""
        self._hand_over()
        packets = self._packets.read(messages)
        if packets.cells is not None and len(packets.cells):
            self.answers += len(packets.cells)
            self._write(f"network.cell.{APP}.{self._name}", packets.cells, self.progress.time_us * 1000)
        if self._by_digest:
            self._write_records(self._unison.packets(_rows(packets)))
        elif self._routes.get("packets") and len(packets):
            # headers are parsed once for all keys: under a flood most packets are wanted under several keys
            self._write_records([_rows(packets)])
        for key, bit in self._routes.get("frames", ()):
            chosen = packets.matching(bit)
            if len(chosen):
                self._write(key, chosen.raw(), int(chosen.time_us[-1]) * 1000)

    def digests(self, lists: list[Any]) -> None:
        """Publish digest lists, in the order of their stream; lists of counts after those of frames."""
        self._hand_over()
        ours, theirs = self._counts.digest_id, self._digests.digest_id
        counts = [each for each in lists if each.digest_id == ours] if ours else []
        frames = [each for each in lists if each.digest_id == theirs]
        self.progress.malformed += len(lists) - len(counts) - len(frames)
        if frames:
            self._write_reports(frames)
        if counts:
            self._write_counts(counts)

    def _write_reports(self, lists: list[Any]) -> None:
        reports = self._digests.read(lists)
        if self._by_digest:
            # where frames that digests do not cover are not copied, there is nothing to wait for
            whole = reports.covered if self._copied else np.ones_like(reports.covered)
            rows = PacketRows(reports.columns, reports.queries, whole)
            self._write_records(self._unison.digests(rows))
        for key, bit in self._routes.get("digests", ()):
            batch = reports.counted(bit)
            if len(batch):
                self._write(key, batch, int(batch["time_us"][-1]) * 1000)

    def _write_counts(self, lists: list[Any]) -> None:
        counts = self._counts.read(lists)
        self.counts_reported += len(counts)
        for key, bit in self._routes.get("counts", ()):
            batch = counts.of(bit)
            if len(batch):
                self._write(key, batch, int(batch["time_us"][-1]) * 1000)

    def rest(self) -> None:
        """Another controller receives the packets, or has received them: what waits is published.  Any thread, soon."""
        self._handovers.append(None)

    def follow(self, sequence: int) -> None:
        """Go on behind another controller.  Any thread, soon: whoever calls must not wait while consumers are behind.

        Args:
            sequence: the highest number that it has reported.
        """
        self._handovers.append(sequence)

    def _hand_over(self) -> None:
        while self._handovers:
            sequence = self._handovers.popleft()
            if sequence is not None:
                self._unison.follow(sequence)
                self.progress.follow(sequence)
                continue
            self._write_records(self._unison.flush())
            self._unison.begin_anew()
            self._waited = 0
            self.progress.rest()

    def settle(self) -> None:
        """Called at intervals: publish records that have waited since the last call, without missing ones."""
        self._hand_over()
        waits = self._unison.waits_for
        if waits and waits == self._waited:
            self._write_records(self._unison.flush())
        self._waited = waits

    def _write_records(self, told: list[PacketRows]) -> None:
        for rows in told:
            for key, bit in self._routes.get("packets", ()):
                batch = rows.matching(bit)
                if len(batch):
                    self._write(key, batch, int(batch["time_us"][-1]) * 1000)


def _rows(packets: PacketInBatch) -> PacketRows:
    return PacketRows(
        dict(packets.batch(read_frames)), packets.queries, np.ones(len(packets), dtype=np.bool_)
    )
