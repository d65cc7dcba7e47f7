"""What a switch sends → DUE: the hot path.

One item for each key that somebody wants, from one batch of the stream, in its order.  `write` blocks
while consumers of reliable keys are behind; then the stream is not read on and the switch is held.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from apps.p4runtime_ctrl.counts_in import CountReader
from apps.p4runtime_ctrl.demand import APP, Demand, Kind, key_of
from apps.p4runtime_ctrl.digest_in import DigestReader
from apps.p4runtime_ctrl.p4info import Program
from apps.p4runtime_ctrl.packet_in import PacketReader, Packets
from apps.p4runtime_ctrl.progress import Progress, Source
from apps.p4runtime_ctrl.unison import Rows, Unison
from apps.packets import read_frames

Write = Callable[[str, Any, int], object]
"""Key, value and event time (ns) of an item to be published at once."""

_SECOND_US: Final = 1_000_000


class Outbound:
    """Publishes packets and reports of the switch `name` through `write`.

    `by_digest`: record batches come from digests, else from copied frames.
    """

    def __init__(
        self, name: str, program: Program, base_us: int, write: Write, *, by_digest: bool = False
    ) -> None:
        self.progress = Progress()
        self._name = name
        self._write = write
        self._by_digest = by_digest
        self._packets = PacketReader(program, base_us, self.progress)
        self._digests = DigestReader(program, base_us, self.progress)
        self._counts = CountReader(program, base_us, self.progress)
        self.answers = 0
        """Cells that the switch told."""
        self.counts_reported = 0
        """Differences that it reported when their window was over."""
        self._routes: dict[Kind, list[tuple[str, int]]] = {}
        self._unison = Unison()
        self._waited = 0

    @property
    def fell_back(self) -> int:
        """Records made from copied frames because digests did not say all."""
        return self._unison.copies

    @property
    def skipped(self) -> int:
        """Frames left out of the records because they came too late, or not at all."""
        return self._unison.skipped

    @property
    def second(self) -> int:
        """The capture's second of the newest frame seen."""
        return self.progress.time_us // _SECOND_US

    def route(self, demand: Demand) -> None:
        """From now on publish what is wanted now."""
        self._routes = {
            kind: [(key_of(kind, self._name, which), bit) for which, bit in routes.items()]
            for kind, routes in demand.routes.items()
        }
        expected: set[Source] = set()
        for request in demand.requests:
            expected |= {"packet"} if request.copy else set()
            expected |= {"digest"} if request.digest else set()
        self.progress.expected = frozenset(expected)

    def packets(self, messages: list[Any]) -> None:
        """Packet-ins, in the order of their stream."""
        packets = self._packets.read(messages)
        if packets.cells is not None and len(packets.cells):
            self.answers += len(packets.cells)
            self._write(f"network.cell.{APP}.{self._name}", packets.cells, self.progress.time_us * 1000)
        if self._by_digest:
            self._write_records(self._unison.packets(_rows(packets)))
        elif self._routes.get("packets") and len(packets):
            # headers are read once for all keys: under a flood most packets are wanted under several
            self._write_records([_rows(packets)])
        for key, bit in self._routes.get("frames", ()):
            chosen = packets.matching(bit)
            if len(chosen):
                self._write(key, chosen.raw(), int(chosen.time_us[-1]) * 1000)

    def digests(self, lists: list[Any]) -> None:
        """Digest lists, in the order of their stream; lists of counts behind those of frames."""
        ours = self._counts.digest_id
        counts = [each for each in lists if each.digest_id == ours] if ours else []
        frames = [each for each in lists if each.digest_id != ours] if counts else lists
        if frames:
            self._write_reports(frames)
        if counts:
            self._write_counts(counts)

    def _write_reports(self, lists: list[Any]) -> None:
        reports = self._digests.read(lists)
        if self._by_digest:
            rows = Rows(reports.columns, reports.queries, reports.covered)
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

    def settle(self) -> None:
        """Called from time to time: records that have waited since the last call go without what is missing."""
        waits = self._unison.waits_for
        if waits and waits == self._waited:
            self._write_records(self._unison.flush())
        self._waited = waits

    def _write_records(self, told: list[Rows]) -> None:
        for rows in told:
            for key, bit in self._routes.get("packets", ()):
                batch = rows.matching(bit)
                if len(batch):
                    self._write(key, batch, int(batch["time_us"][-1]) * 1000)


def _rows(packets: Packets) -> Rows:
    return Rows(dict(packets.batch(read_frames)), packets.queries, np.ones(len(packets), dtype=np.bool_))
