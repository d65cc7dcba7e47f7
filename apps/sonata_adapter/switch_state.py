"""What the adapter keeps for one switch: its clock, host operators with their streams, readers of reports.  Pure."""

from collections.abc import Callable

from apps.sonata_adapter.host.engine import WindowEngine
from apps.sonata_adapter.host.handshake import Handshakes
from apps.sonata_adapter.host.merge import Merger
from apps.sonata_adapter.planner.refinement import Crossings
from apps.sonata_adapter.results import Captured, QueryResult
from apps.sonata_adapter.switch.clock import Clock
from apps.sonata_adapter.switch.differences import Differences
from apps.sonata_adapter.switch.register_reads import RegisterReads
from apps.sonata_adapter.switch.reports import CountReportReader
from due import RecordBatch

Counts = CountReportReader | RegisterReads | Differences | Crossings


class Lane:
    """Host operators and their input stream; queries on frame bytes have a lane of their own."""

    def __init__(self, host: WindowEngine) -> None:
        self.host = host
        self.merger = Merger()
        self.names: set[str] = set()
        """The streams from which its packets come."""
        self.opens = ""
        """Of a query with a gate in the switch: the stream of packets that have passed it."""
        self.brought: dict[str, int] = {}
        """Packets by stream."""

    def run(self, batch: RecordBatch | None, now: float | None) -> list[QueryResult | Captured]:
        """Run packets through the operators; a window closes when all streams have passed its end."""
        horizon = None if now is None else self.merger.horizon_us(now)
        outputs: list[QueryResult | Captured] = []
        if batch is not None:
            outputs += self.host.process(batch, horizon_us=0 if horizon is None else horizon)
        if horizon is not None:
            outputs += self.host.advance(horizon)
        return outputs


class SwitchState:
    """The state kept for one switch."""

    def __init__(self, name: str, engine: Callable[[], WindowEngine], base_us: int) -> None:
        self.name = name
        self.headers = Lane(engine())
        self.frames = Lane(engine())
        self.gated: dict[str, Lane] = {}
        """By query, of those with a gate in the switch: what the switch says of packets holds for one query only."""
        self.handshakes = Handshakes()
        self.reports: dict[str, Counts] = {}
        self.base_us = base_us
        for lane in self.lanes:
            lane.host.base_us = base_us
        self.clock = Clock()

    @property
    def asking(self) -> list[RegisterReads | Differences]:
        """The counts for which cells of the switch are read."""
        return [each for each in self.reports.values() if isinstance(each, (RegisterReads, Differences))]

    @property
    def lanes(self) -> tuple[Lane, ...]:
        return self.headers, self.frames, *self.gated.values()

    def set_back(self, now_us: int) -> list[QueryResult | Captured]:
        """The switch's clock was set back to `now_us`: report what is open, whose time it was not, and begin anew."""
        outputs: list[QueryResult | Captured] = []
        for report in self.reports.values():
            outputs += report.set_back(now_us)
        for lane in self.lanes:
            outputs += lane.run(lane.merger.set_back(), None)
            outputs += lane.host.set_back(now_us)
        self.clock = Clock()
        self.clock.hear(now_us)
        return outputs
