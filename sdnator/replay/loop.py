"""Replay a capture through the whole loop.

    Capture ─► feed ─► switch ─► controller ─► Kitsune ─► scores ─┐
                 ▲                                                │ window of packets in flight
                 └────────────────────────────────────────────────┘

The feeder keeps a bounded number of packets in flight, counted by scored + dropped, so that no queue
of the loop can overflow.  A replay may be a hundred times as fast as its capture.  So that time to block says nothing
about that, and neither the window nor the machine decides, it goes in laps of the reaction time (`laps.py`): the next
lap is sent once the packets of this one are scored, their evidence is judged, and the switch has confirmed what was
decided.  On a quiet network that takes long, so it does so only where a dry run of the capture has shown that something
may be decided, if there was one (`quiet_stretches.py`).
"""

import select
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from apps.incidents import INCIDENTS, Incident
from apps.messages import Alert, Confirmation, Decision
from apps.sonata_adapter.keys import HANDSHAKE
from dataplane.ports.capture_port import CapturePortError
from due import CONSUMER, NO_WAIT, PRODUCER, Capability, Engine, Interest
from sdnator.capture.capture_blocks import CaptureBlocks
from sdnator.capture.interfaces import Feed
from sdnator.errors import PipelineError
from sdnator.incidents.incident_rows import newest_of_each, with_counters
from sdnator.replay.drop_counters import DropCounters
from sdnator.replay.laps import REACTION_NS, Laps
from sdnator.replay.loop_observer import (
    CONFIRM_SECONDS,
    JUDGING,
    REPORTS,
    SUSPICIONS,
    LoopObserver,
)
from sdnator.replay.packet_accounting import PacketAccounting, PacketState
from sdnator.replay.pipeline import SWITCH_NAME, PipelinePlan, ReplayPipeline
from sdnator.replay.quiet_stretches import STOPPING, QuietStretches, Sign
from sdnator.replay.readiness import QueriesReady
from sdnator.replay.survey import Survey

if TYPE_CHECKING:
    from p4rt import ChannelSecurity

CHUNK = 16_384
"""Most packets sent at a time."""
SHARE = 4
"""A quarter of the window is free before more is sent, so that every stage gets packets in batches."""
FREE_WINDOW = {"digest": 65_536, "packet-in": 1_024}
"""Most packets in flight while nothing can be blocked, by the way in which headers come."""
BLOCKING_WINDOW = 128
"""Most packets in flight while a block may take effect, unless `--window` says otherwise."""
LAP_LINGER_MS = 0.2
"""How long the controller waits for more headers in a pass with laps ..."""
FREE_LINGER_MS = 2.0
"""... and in a pass without."""
STALL_SECONDS = 90.0
"""Seconds without any result after which the loop has failed."""
SETTLE_SECONDS = 0.5
"""Without verdicts: seconds of silence after which packets in flight count as dropped or lost."""
ASK_SECONDS = 0.003
"""Without verdicts: seconds of silence after which drop counters are read."""
WIRE_WINDOW = 16
"""Most packets in flight into a real interface: BMv2's capture ring has 32 slots, the kernel drops the rest."""
REPRODUCIBLE_WINDOW = 16
"""Packets of a lap with `--reproducible`, whatever `--window` says: as many as every switch takes."""
POLL_SECONDS = 0.002
LOOK_SECONDS = 0.1
DEATH_SECONDS = 5.0
"""Seconds from a part's closed sockets to the end of its process."""
COORDINATED = "coordinated"
"""Phase of an engine whose declarations the Coordinator knows."""
PACKETS = "packets"
"""The controller's name for the request of every packet."""
INTERESTS = (
    Interest("network.anomaly.kitsune.score"),
    Interest("network.anomaly.kitsune.alert"),
    Interest("network.block.firewall.*"),
    Interest("network.block_prefix.firewall.*"),
    Interest("network.protect.firewall.*"),
    Interest("network.meter.firewall.*"),
    Interest("network.confirmation.p4runtime_ctrl.*"),
    Interest("network.switch.p4runtime_ctrl.*"),
    Interest(INCIDENTS),
    Interest(JUDGING),
    Interest(SUSPICIONS),
)
QUERY_INTERESTS = (Interest(HANDSHAKE), Interest(REPORTS))
CAPABILITIES = (Capability("network.clock.replay.*", delivery="reliable"),)
AFTER_END_NS = 2_000_000_000
"""Capture time that passes in silence after the last packet: seconds and windows end, and what waits is decided."""
QUIET_SECONDS = 0.5
"""Seconds without a decision, an alert or a confirmation after which nothing more is expected of a capture's end."""


Telemetry = Literal["packet-in", "digest"]


@dataclass(frozen=True, kw_only=True)
class ReplayOptions:
    """How a capture is replayed."""

    switch: str = "embedded"
    security: "ChannelSecurity | None" = None
    """How channels to an external switch are secured."""
    inject: str | None = None
    """Interface to send frames into, for a switch that is already running."""
    fm_grace: int = 5_000
    """Packets from which the feature map is learnt."""
    ad_grace: int = 50_000
    """Packets on which the autoencoders are trained."""
    pace: float | None = None
    """Capture seconds a wall second; None = as fast as the loop goes."""
    window: int | None = None
    """Most packets in flight; None = many while nothing can be blocked, else few."""
    reaction_ns: int = REACTION_NS
    """Capture time that may pass from a packet to a remedy for it."""
    reproducible: bool = False
    """Trust nothing that the dry run foretells behind the first block, and make laps that no window changes."""
    telemetry: Telemetry | None = None
    """How headers come from the switch; None = by digest where the switch sends them in lists."""
    queries: bool = True
    """Run the Sonata adapter, and the parts of the firewall that need it; False: Kitsune alone."""
    model: Path | None = None
    """A trained model; None = train on the first packets."""
    keep: Path | None = None
    """Folder in which logs, settings and the archive of the passes stay; None = they are deleted."""

    def in_flight_limit(self, *, free: bool) -> int:
        """Most packets in flight on the chosen switch; `free`: while nothing can be blocked."""
        window = (
            (FREE_WINDOW[self.headers] if free else BLOCKING_WINDOW) if self.window is None else self.window
        )
        return window if self.switch == "embedded" else min(window, WIRE_WINDOW)

    @property
    def lap_packets(self) -> int:
        """Most packets of a lap."""
        limit = self.in_flight_limit(free=False)
        return min(REPRODUCIBLE_WINDOW if self.reproducible else BLOCKING_WINDOW, limit)

    @property
    def unhindered(self) -> bool:
        """Whether nothing but the loop itself limits the speed of a replay."""
        return self.switch == "embedded" and self.pace is None and self.window is None

    @property
    def headers(self) -> Telemetry:
        """How headers come from the chosen switch."""
        return self.telemetry or ("digest" if self.switch == "embedded" else "packet-in")

    @property
    def training_packets(self) -> int:
        """Packets that Kitsune trains on: the reference trains on one more than asked for; none with a model."""
        return self.fm_grace + self.ad_grace + 1 if self.model is None else 0

    @property
    def kitsune(self) -> dict[str, Any]:
        """Settings of Kitsune."""
        chosen: dict[str, Any] = {"fm_grace": self.fm_grace, "ad_grace": self.ad_grace, "mode": "reference"}
        return chosen | ({"load_model": str(self.model.absolute())} if self.model is not None else {})


@dataclass(eq=False)
class PassResult:
    """Result of one pass through the loop."""

    flight: PacketAccounting
    mitigate: bool
    seconds: float = 0.0
    lost_on_the_way: int = 0
    """Gaps in the packet-in sequence numbers, as the controller counted them."""
    uncounted_drops: int = 0
    """Packets taken for dropped that no drop counter has: they were lost."""
    drops_counted: dict[str, int] = field(default_factory=dict)
    """Last drop counter of each block, by its id."""
    alerts: list[Alert] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    """Blocks and guards, and their ends, in the order of deciding."""
    signs: list[Sign] = field(default_factory=list)
    """What may lead to a decision: evidence, results of queries, decisions."""
    overtaken: int = 0
    """Decisions that came while packets were sent freely: they took effect later than they should have."""
    handshakes: list[tuple[int, str]] = field(default_factory=list)
    """Capture time (ns) and source of each completed handshake that a query has found."""
    confirmations: list[Confirmation] = field(default_factory=list)
    incidents: list[Incident] = field(default_factory=list)
    """Reports of the firewall, in the order of writing: the last of an id holds."""
    sent_at: dict[int, float] = field(default_factory=dict)
    """Wall time (monotonic) at which watched packets were sent."""
    confirmed_at: list[float] = field(default_factory=list)
    """Wall time of each confirmation."""
    confirmed_sent: list[int] = field(default_factory=list)
    """Packets sent by the time of each confirmation."""

    def last_incidents(self) -> list[Incident]:
        """Incidents as last reported, with the last counters of the switch, in the order of their begin."""
        return [with_counters(each, self.drops_counted) for each in newest_of_each(self.incidents)]


Progress = Callable[[PacketAccounting, int], None]
"""Called at intervals with the packet accounting and the number of blocks so far."""


class ReplayPass:
    """One pass of a capture through a fresh pipeline.

    Args:
        survey: the capture, read once before.
        options: how to replay.
        mitigate: False = the firewall decides but nothing is installed.
        watch: indices of packets whose time of sending matters.
        dry_run: an earlier pass of the same capture without mitigation, if there was one.
        foresees: whether the dry run may foretell what happens behind the first block.
        gives_up: end it with the first decision that was overtaken: it will be made again.
    """

    def __init__(
        self,
        survey: Survey,
        options: ReplayOptions,
        *,
        mitigate: bool,
        watch: frozenset[int],
        dry_run: PassResult | None = None,
        foresees: bool = True,
        gives_up: bool = False,
    ) -> None:
        self._survey = survey
        self._gives_up = gives_up
        self._options = options
        self._watch = watch
        flight = PacketAccounting(
            survey.packets,
            verdicts=options.switch == "embedded",
            by_digest=options.headers == "digest",
        )
        self._result = PassResult(flight, mitigate)
        self._quiet = None if dry_run is None else _quiet_stretches(survey, dry_run, foresees=foresees)
        self._laps = Laps(survey.time_ns, options.reaction_ns, options.lap_packets)
        self._lap_end = 0
        self._observer = LoopObserver(self._result, self._quiet)
        self._drops: DropCounters | None = None
        self._looked = 0.0

    def run(self, progress: Progress | None = None) -> PassResult:
        """Run it to the last packet; raises PipelineError if a part fails or the loop stalls."""
        options = self._options
        name = "with-blocking" if self._result.mitigate else "dry-run"
        with tempfile.TemporaryDirectory(prefix="sdnator-", ignore_cleanup_errors=True) as temporary:
            folder = Path(temporary) if options.keep is None else options.keep.absolute() / name
            folder.mkdir(parents=True, exist_ok=True)
            engine = Engine()
            plan = PipelinePlan(
                folder=folder,
                switch=options.switch,
                security=options.security,
                inject=options.inject,
                base_us=self._survey.base_us,
                times_us=self._survey.time_ns // 1_000,
                telemetry=options.headers,
                linger_ms=LAP_LINGER_MS if self._result.mitigate else FREE_LINGER_MS,
                first=partial(self._join, engine),
                kitsune=options.kitsune,
                queries=options.queries,
                keeps_archive=options.keep is not None,
                firewall=_firewall(mitigate=self._result.mitigate, queries=options.queries),
            )
            with ReplayPipeline(plan) as pipeline:
                self._run(pipeline, engine, progress)
        return self._result

    def _join(self, engine: Engine, pipeline: ReplayPipeline) -> None:
        """Register our interests before any app runs, so that Kitsune's first scores are wanted."""
        pipeline.before_stop(engine.close)
        engine.set_pubsub(pipeline.updates)
        engine.set_db(pipeline.archive)
        interests = (*INTERESTS, *(QUERY_INTERESTS if self._options.queries else ()))
        engine.init("replay", PRODUCER | CONSUMER, interests=interests, capabilities=CAPABILITIES)
        self._observer.subscribe(engine)
        if self._options.queries:
            self._observer.subscribe_queries(engine)
        deadline = time.monotonic() + STALL_SECONDS
        while engine.health()["phase"] != COORDINATED:
            pipeline.check()
            if time.monotonic() > deadline:
                raise PipelineError(f"the Coordinator did not answer within {STALL_SECONDS:.0f} s")
            time.sleep(0.01)

    def _run(self, pipeline: ReplayPipeline, engine: Engine, progress: Progress | None) -> None:
        self._wait_for_packets(pipeline, engine)
        started = time.monotonic()
        with ExitStack() as stack:
            try:
                feed = pipeline.feed()
                stack.callback(feed.close)
                if not pipeline.gives_verdicts:
                    self._drops = stack.enter_context(pipeline.drop_counters())
                self._feed(pipeline, engine, feed, progress)
                self._result.seconds = time.monotonic() - started
                self._end(pipeline, engine)
                if not pipeline.gives_verdicts:
                    self._await_drop_counters(pipeline)
            except CapturePortError as error:
                _name_the_dead(pipeline)
                raise PipelineError(str(error)) from error

    def _wait_for_packets(self, pipeline: ReplayPipeline, engine: Engine) -> None:
        """Wait until the switch sends packets, because Kitsune and queries want them.

        Its state item may be older than our subscription, so the archive is read as well.
        """
        deadline = time.monotonic() + STALL_SECONDS
        queries = QueriesReady(pipeline.coordinator) if self._options.queries else None
        while True:
            states = [item.value for item in engine.get(f"network.switch.p4runtime_ctrl.{SWITCH_NAME}")]
            with self._observer.moved:
                latest = self._observer.switch or (states[-1] if states else {})
            telemetry = latest.get("telemetry", ())
            sends = latest.get("primary") and PACKETS in telemetry
            if sends and (queries is None or queries.look(telemetry)):
                return
            pipeline.check()
            if sends and queries is not None and time.monotonic() > deadline:
                raise PipelineError(f"queries are not served after {STALL_SECONDS:.0f} s: {queries.missing}")
            if time.monotonic() > deadline:
                raise PipelineError(
                    f"switch {SWITCH_NAME} did not begin to send packets within {STALL_SECONDS:.0f} s; "
                    f"its last state: {latest or 'none'}"
                )
            time.sleep(0.05)

    def _feed(self, pipeline: ReplayPipeline, engine: Engine, feed: Feed, progress: Progress | None) -> None:
        flight = self._result.flight
        begun = time.monotonic()
        with CaptureBlocks(self._survey.path, self._survey.frames()) as capture:
            while flight.sent < self._survey.packets and not (self._gives_up and self._result.overtaken):
                room = self._wait_for_room(pipeline, engine, feed, progress)
                block = capture.take(self._keep_pace(pipeline, progress, begun, min(room, CHUNK)))
                self._look(pipeline, progress)
                # Counted first: a verdict or score may come back before `send` returns.
                self._note_watched(flight.sent, len(block))
                with self._observer.moved:
                    flight.send(len(block))
                feed.send_block(block)
        self._drain(pipeline, feed, progress)
        self._looked = 0.0
        self._look(pipeline, progress)

    def _end(self, pipeline: ReplayPipeline, engine: Engine) -> None:
        """Let capture time pass after the last packet, and wait for what is decided by it."""
        self._await_quiet(pipeline)  # what the last packets lead to comes first
        end = int(self._survey.time_ns.max()) + AFTER_END_NS
        self._write_clock(engine, end)
        deadline = time.monotonic() + CONFIRM_SECONDS
        with self._observer.moved:
            while self._observer.switch.get("event_time", 0) < end and time.monotonic() < deadline:
                pipeline.check()
                self._observer.moved.wait(0.05)
        self._await_quiet(pipeline)
        self._await_confirmations(pipeline)

    def _await_quiet(self, pipeline: ReplayPipeline) -> None:
        began = time.monotonic()
        while (now := time.monotonic()) < began + CONFIRM_SECONDS:
            if now - max(began, self._observer.last) >= QUIET_SECONDS:
                return
            pipeline.check()
            time.sleep(0.02)

    def _await_confirmations(self, pipeline: ReplayPipeline) -> None:
        """Wait until the firewall's decisions are confirmed by the switch."""
        deadline = time.monotonic() + CONFIRM_SECONDS

        def confirmed() -> bool:
            answered = {confirmation.id for confirmation in self._result.confirmations}
            return all(decision.dry_run or decision.id in answered for decision in self._result.decisions)

        with self._observer.moved:
            while not confirmed() and time.monotonic() < deadline:
                pipeline.check()
                self._observer.moved.wait(0.05)

    def _await_drop_counters(self, pipeline: ReplayPipeline) -> None:
        """Without verdicts, check by the switch's counters which packets were really dropped."""
        deadline = time.monotonic() + CONFIRM_SECONDS
        dropped = self._result.flight.count(PacketState.DROPPED)
        with self._observer.moved:
            while sum(self._result.drops_counted.values()) < dropped and time.monotonic() < deadline:
                pipeline.check()
                self._observer.moved.wait(0.05)
            self._result.uncounted_drops = max(0, dropped - sum(self._result.drops_counted.values()))

    def _note_watched(self, first: int, count: int) -> None:
        for index in self._watch:
            if first <= index < first + count:
                self._result.sent_at[index] = time.monotonic()

    def _keep_pace(self, pipeline: ReplayPipeline, progress: Progress | None, begun: float, most: int) -> int:
        """Wait for the next packet's time; how many are due then, at least 1 and at most `most`."""
        if self._options.pace is None:
            return most
        sent, times_ns = self._result.flight.sent, self._survey.time_ns
        due_at = begun + float(times_ns[sent] - times_ns[0]) / 1e9 / self._options.pace
        while (ahead := due_at - time.monotonic()) > 0:
            time.sleep(min(ahead, LOOK_SECONDS))
            self._look(pipeline, progress)
        now_ns = int(times_ns[0]) + int((time.monotonic() - begun) * self._options.pace * 1e9)
        late = times_ns[sent : sent + most] > now_ns
        return max(1, int(late.argmax()) if late.any() else len(late))

    def _look(self, pipeline: ReplayPipeline, progress: Progress | None) -> None:
        """At intervals: check that every part runs, and report progress."""
        now = time.monotonic()
        if now - self._looked > LOOK_SECONDS:
            self._looked = now
            pipeline.check()
            if progress is not None:
                progress(self._result.flight, self._observer.blocks)

    def _wait_for_room(
        self, pipeline: ReplayPipeline, engine: Engine, feed: Feed, progress: Progress | None
    ) -> int:
        sent = self._result.flight.sent
        if sent < self._lap_end:
            return self._lap_end - sent  # the rest of a lap that came in parts
        with self._observer.moved:
            free = self._free_until(sent) - sent
        if free > 0:
            limit = self._options.in_flight_limit(free=True)
            share = max(1, limit // SHARE)
            self._await(pipeline, feed, progress, lambda flight: flight.in_flight <= limit - share)
            with self._observer.moved:
                free = self._free_until(sent) - sent  # something may have come meanwhile
                self._observer.is_free = free > 0
                if free > 0:
                    return min(limit - self._result.flight.in_flight, free)
        self._await(pipeline, feed, progress, self._is_settled)
        end_ns = self._pass_ends(pipeline, engine, int(self._survey.time_ns[sent]))
        self._observer.is_free = False
        self._lap_end = self._laps.end(sent, end_ns)
        return self._lap_end - sent

    def _free_until(self, sent: int) -> int:
        """Index of the first packet, from that of `sent` on, that may meet a decision."""
        if not self._result.mitigate:
            return self._survey.packets
        if sent < self._options.training_packets:
            return self._options.training_packets
        return sent if self._quiet is None else self._quiet.end(sent)

    def _is_settled(self, flight: PacketAccounting) -> bool:
        """Whether everything that was sent is scored and judged, and what was decided is in force."""
        return not flight.in_flight and not self._observer.is_judging() and not self._observer.is_deciding()

    def _pass_ends(self, pipeline: ReplayPipeline, engine: Engine, next_ns: int) -> int | None:
        """Blocks that end before the next packet end at their time, whenever that packet comes.

        Returns:
            Capture time of the next end, ns; None if nothing in force ends.
        """
        while True:
            with self._observer.moved:
                end = self._observer.next_end()
                if end is None or end > next_ns:
                    return end
            self._write_clock(engine, -(-end // 1_000) * 1_000)  # the switch's clock counts microseconds
            deadline = time.monotonic() + CONFIRM_SECONDS
            with self._observer.moved:
                while self._observer.next_end() == end or self._observer.is_deciding():
                    if time.monotonic() > deadline:
                        self._observer.give_up_end(end)
                        break
                    pipeline.check()
                    self._observer.moved.wait(LOOK_SECONDS)

    def _write_clock(self, engine: Engine, time_ns: int) -> None:
        engine.write(f"network.clock.replay.{SWITCH_NAME}", {"event_time": time_ns}, [NO_WAIT])

    def _drain(self, pipeline: ReplayPipeline, feed: Feed, progress: Progress | None) -> None:
        self._await(pipeline, feed, progress, lambda flight: flight.in_flight == 0)

    def _await(
        self,
        pipeline: ReplayPipeline,
        feed: Feed,
        progress: Progress | None,
        done: Callable[[PacketAccounting], bool],
    ) -> None:
        """Receive verdicts and scores until `done`; raises PipelineError if the loop stalls."""
        flight = self._result.flight
        last, since = -1, time.monotonic()
        while True:
            with self._observer.moved:
                flight.judge(feed.verdicts())
                if done(flight):
                    return
                # scores wake us, verdicts do not
                judging = pipeline.gives_verdicts and flight.judged < flight.sent
                if not judging:
                    waiting = not pipeline.gives_verdicts and flight.in_flight
                    self._observer.moved.wait(POLL_SECONDS if waiting else LOOK_SECONDS)
            if judging:
                select.select((feed,), (), (), POLL_SECONDS)
            now = time.monotonic()
            if flight.decided != last:
                last, since = flight.decided, now
            elif self._observer.blocks:
                self._settle(now - since)
            self._look(pipeline, progress)
            if now - since > STALL_SECONDS:
                raise PipelineError(
                    f"the loop is stuck: {flight.in_flight} of {flight.sent} packets sent are neither scored "
                    f"nor dropped after {STALL_SECONDS:.0f} s"
                    + (
                        ""
                        if pipeline.gives_verdicts
                        else "; frames were lost on the wire: try a smaller --window"
                    )
                )

    def _settle(self, silence: float) -> None:
        """Check whether all packets in flight were dropped."""
        flight = self._result.flight
        if self._drops is not None and silence > ASK_SECONDS:
            drops = self._drops.dropped()
            with self._observer.moved:
                flight.settle_counted(drops)
        if silence > SETTLE_SECONDS:
            with self._observer.moved:
                flight.settle()


def _quiet_stretches(survey: Survey, dry_run: PassResult, *, foresees: bool) -> QuietStretches:
    """What the dry run tells about the pass after it."""
    stopping = (decision.event_time for decision in dry_run.decisions if decision.action in STOPPING)
    return QuietStretches(survey.time_ns, dry_run.signs, min(stopping, default=None), foresees=foresees)


def _firewall(*, mitigate: bool, queries: bool) -> dict[str, Any]:
    """Settings of the firewall: nobody in a capture can answer a challenge, and no server there takes a reset."""
    without = {} if queries else {"detect": False, "learn": False}
    return {"rules": {"dry_run": not mitigate}, "syn": {"challenge": False}, **without}


def _name_the_dead(pipeline: ReplayPipeline) -> None:
    """Raise PipelineError with the part that died, and its cause; return if none has."""
    deadline = time.monotonic() + DEATH_SECONDS
    while time.monotonic() < deadline:
        pipeline.check()
        time.sleep(POLL_SECONDS)


def wall_seconds_to_block(result: PassResult, first_attack: int | None) -> float | None:
    """Wall seconds from the sending of the first attack packet to the first installed block."""
    begun = result.sent_at.get(first_attack) if first_attack is not None else None
    if begun is None:
        return None
    installed = [
        at
        for confirmation, at in zip(result.confirmations, result.confirmed_at, strict=True)
        if confirmation.state == "installed"
    ]
    return installed[0] - begun if installed else None
