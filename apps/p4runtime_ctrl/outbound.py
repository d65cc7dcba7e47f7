"""What a switch sends → DUE: the hot path.

One item for each key that somebody wants, from one batch of the stream, in its order.  `write` blocks
while consumers of reliable keys are behind; then the stream is not read on and the switch is held.
"""

from collections.abc import Callable
from typing import Any, Final

from apps.p4runtime_ctrl.demand import Demand, Kind, key_of
from apps.p4runtime_ctrl.digest_in import DigestReader
from apps.p4runtime_ctrl.p4info import Program
from apps.p4runtime_ctrl.packet_in import PacketReader
from apps.p4runtime_ctrl.progress import Progress, Source
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
        self._routes: dict[Kind, list[tuple[str, int]]] = {}

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
        for key, bit in () if self._by_digest else self._routes.get("packets", ()):
            chosen = packets.matching(bit)
            if len(chosen):
                self._write(key, chosen.batch(read_frames), int(chosen.time_us[-1]) * 1000)
        for key, bit in self._routes.get("frames", ()):
            chosen = packets.matching(bit)
            if len(chosen):
                self._write(key, chosen.raw(), int(chosen.time_us[-1]) * 1000)

    def digests(self, lists: list[Any]) -> None:
        """Digest lists, in the order of their stream."""
        reports = self._digests.read(lists)
        for key, bit in self._routes.get("packets", ()) if self._by_digest else ():
            batch = reports.records(bit)
            if len(batch):
                self._write(key, batch, int(batch["time_us"][-1]) * 1000)
        for key, bit in self._routes.get("digests", ()):
            batch = reports.counted(bit)
            if len(batch):
                self._write(key, batch, int(batch["time_us"][-1]) * 1000)
