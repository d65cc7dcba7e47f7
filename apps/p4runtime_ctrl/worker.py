"""The worker of one switch, between DUE and the switch.  I/O.

packets thread of a connection   packet-ins → record batch → DUE (blocks while consumers are behind)
worker thread of a switch        decisions first; then commands, requests and state, in order
thread of a counter read         reads a switch's counters, which may take tenths of a second
DUE's dispatcher                 puts work into the worker's bounded queue
"""

import logging
import queue
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from apps.messages import Confirmation, Decision, Intake, MessageError, TableCommand, one_line
from apps.p4runtime_ctrl.arrivals import FramesToSend, SwitchTold
from apps.p4runtime_ctrl.counter_reads import CounterReads
from apps.p4runtime_ctrl.duty import SwitchDuty
from apps.p4runtime_ctrl.errors import ControllerError, EntryError, Malformed, SwitchError
from apps.p4runtime_ctrl.packet_publisher import PacketPublisher
from apps.p4runtime_ctrl.settings import Settings, SwitchSettings
from apps.p4runtime_ctrl.southbound.capture_times import CaptureTimes
from apps.p4runtime_ctrl.southbound.connection import Connection, Listener
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.packet_out import PacketOuts
from apps.p4runtime_ctrl.southbound.session import P4RuntimeSession
from apps.p4runtime_ctrl.state.decision_ends import DecisionEnds
from apps.p4runtime_ctrl.state.desired_state import check_entry
from apps.p4runtime_ctrl.state.desired_switch import DesiredSwitch
from apps.p4runtime_ctrl.state.live_clock import LiveClock
from apps.p4runtime_ctrl.state.mac_learning import DIGEST
from apps.p4runtime_ctrl.switch_history import SwitchHistory
from apps.p4runtime_ctrl.telemetry.coverage import FALLBACK
from apps.p4runtime_ctrl.telemetry.demand import Demand
from apps.p4runtime_ctrl.telemetry.telemetry_counters import TelemetryCounters
from due import NO_WAIT, PUB_ONLY, Engine, RecordBatch
from due.errors import BackendError

_LOG = logging.getLogger(__name__)
_JOBS: Final = 10_000
_LOOK_S: Final = 0.1
_ALIVE_S: Final = 1.0
_SETTLE_S: Final = 1.0
_SETTLE_LOSSLESS_S: Final = 15.0
"""As `_SETTLE_S`, in a replay on the embedded switch: nothing is lost on the way there, but a machine with too much to
do may stand still for seconds."""
_AWAY_S: Final = 2.0
"""Seconds; a switch that dies is there again sooner, and does not go to another controller for it."""
_UNCONFIRMED_S: Final = 15.0
"""What the primary controller of a switch has not confirmed after once or twice this time, it confirms no more."""

Connect = Callable[[Listener], Connection]
_Job = Callable[[], None]


class SwitchWorker:
    """Keeps one switch as desired, and publishes what it sends."""

    problem: str = "no answer yet"
    """Why the switch is not under control; empty: it is, or another controller controls it."""

    def __init__(
        self,
        engine: Engine,
        settings: Settings,
        mine: SwitchSettings,
        program: ProgramInfo,
        connect: Connect,
        intake: Intake | None = None,
    ) -> None:
        self.name = mine.name
        self._engine = engine
        self._intake = intake or Intake(_LOG)
        self._mine = mine
        self._settings = settings
        self._program = program
        self._outbound = PacketPublisher(
            mine.name,
            self._program,
            mine.base_us,
            self._publish,
            by_digest=settings.by_digest(mine),
            times=CaptureTimes.load(Path(mine.capture_times)) if mine.capture_times else None,
        )
        self._progress = self._outbound.progress
        self._packet_outs = PacketOuts(self._program, mine.base_us)
        self._sent = {"cells_asked": 0, "frames_sent": 0, "packet_outs_refused": 0}
        self._program_name = Path(settings.program).name
        self._switch = DesiredSwitch(
            mine.name,
            self._program,
            self._now,
            forward={int(port): egress for port, egress in mine.forward.items()},
            fail=mine.fail,
            guard=settings.guard,
            learn=mine.learn,
        )
        self._learn_id = self._program.digest_id(DIGEST)
        self._connection = connect(self)
        self._jobs: queue.Queue[_Job] = queue.Queue(_JOBS)
        self._closing = threading.Event()
        self._worker = threading.Thread(target=self._work, name=f"switch {mine.name}", daemon=True)
        self._session: P4RuntimeSession | None = None
        self._connected = self._was_backup = False
        self._duty = SwitchDuty(lambda: engine.instance_id, divided=settings.instances == "sharded")
        self._history = SwitchHistory(engine, settings, mine, self._intake)
        self._aged_at = 0.0
        self._urgent: deque[Decision] = deque()
        """Decisions to carry out, before any other work."""
        self._ends = DecisionEnds()
        self._clock = LiveClock(mine.clock, time.time_ns() // 1000 if mine.clock == "own" else 0)
        self._counters = CounterReads(
            self._switch,
            session=lambda: self._session,
            second=lambda: self._outbound.second,
            put=self._put,
            told=self._write_state,
            pause_s=settings.counters_ms / 1000,
        )
        self._telemetry_counters = TelemetryCounters(
            mine.name, program, self._publish_counters, lambda error: self._put(partial(_fail, error))
        )
        self._publishing = threading.Lock()
        self._away_since = time.monotonic()
        self._alive_at = 0.0
        self._settled_at = 0.0
        lossless = mine.clock == "packets" and mine.target == "embedded"
        self._settle_s = _SETTLE_LOSSLESS_S if lossless else _SETTLE_S
        self._secret_at = float("-inf")
        self._left_out: list[str] = []
        self._stated = (0, 0, 0.0)
        self._change = "starting"
        self._brought_up_ms = 0.0
        self.settled = threading.Event()
        """The first attempt to reach the switch has succeeded or failed."""

    # -- from the service ---------------------------------------------------------------------

    def start(self, *, active: bool) -> None:
        self._restore()
        self._worker.start()
        self.stand(active=active)
        self._connection.open()

    def stand(self, *, active: bool) -> None:
        """Become active or standby; where the switches are divided, one that is primary goes on until another one is."""
        if self._duty.divided:
            self._duty.give(granted=active)
        if active or not self._duty.divided or self._session is None:
            self._connection.stand(active=active)

    def told(self, told: SwitchTold, instance: str) -> None:
        """Another controller has said how the switch is."""
        if self._session is None:
            self._duty.heard(told, instance, time.monotonic())

    @property
    def within_reach(self) -> bool:
        """Whether this controller can have the switch: it is connected, or was moments ago."""
        return self._connected or time.monotonic() - self._away_since < _AWAY_S

    def insist(self) -> None:
        """This is the controller of the switch: let it be primary."""
        if self._duty.backup and self._connection.outbid():
            _LOG.warning("%s: claiming the switch from another controller of no higher rank", self.name)

    def stop(self) -> None:
        self._put(self._leave)
        self._closing.set()
        self._worker.join(timeout=self._settings.timeout_s * 2)
        self._connection.close()

    def decide(self, decision: Decision, at: int) -> None:
        """Queue a decision, and when it was written; a mirror carries none out: its counter would claim a stop."""
        if self._mine.mirror:
            return
        self._history.heard(decision, at)
        self._urgent.append(decision)
        self._put(self._decide)

    def command(self, command: TableCommand, at: int) -> None:
        if self._duty.divided:
            self._history.heard_command(command, at)
        self._put(partial(self._command, command))

    def want(self, demand: Demand) -> None:
        self._put(partial(self._want, demand))

    def ask(self, questions: RecordBatch) -> None:
        """Queue a request to read cells of counting stages."""
        self._put(partial(self._ask, questions))

    def send(self, frames: FramesToSend) -> None:
        """Queue frames for the switch to send."""
        self._put(partial(self._send, frames))

    def clock_reached(self, event_time: int) -> None:
        """The program that feeds a switch reports the capture time reached, ns; for switches whose time is moved by packets alone."""
        if self._mine.clock == "packets":
            self._put(partial(self._pass_time, event_time // 1000))

    def say_again(self) -> None:
        """Publish the state again for a new consumer: it is best effort and published on change only."""
        self._put(self._write_state)

    @property
    def _works(self) -> bool:
        return self._worker.is_alive() and self._connection.works

    def wait_settled(self, deadline: float) -> None:
        """Return when the first attempt to reach the switch has succeeded or failed, or a thread has died.

        Args:
            deadline: s, monotonic; return then at the latest.
        """
        while self._works and time.monotonic() < deadline and not self.settled.wait(_LOOK_S):
            pass

    def tick(self) -> None:
        """Periodic work by wall clock: check that the switch answers, read counters, publish state changes."""
        if not self._works:
            raise ControllerError(f"{self.name}: a thread has ended with an error; the log has the reason")
        now = time.monotonic()
        if self._session is not None and now - self._alive_at > _ALIVE_S and self._jobs.empty():
            self._alive_at = now
            self._put(self._check_alive)
        self._counters.look(now)
        self._telemetry_counters.look(self._session, now)
        self._settle(now)
        if self._duty.divided:
            self._look_at_duty(now)
        ends_us = self._ends.next_us
        time_us = self._clock.look(
            self._progress.time_us, self._progress.received + self._progress.reported, now, ends_us
        )
        if time_us is not None:
            self._put(partial(self._pass_time, time_us))
        elif 0 < ends_us <= self._progress.time_us and self._mine.clock != "packets":
            self._put(self._say_ends)
        if self._switch.guards and now - self._secret_at > self._settings.guard.rotate_s:
            self._secret_at = now
            self._put(self._change_secret)
        received, lost, stated_at = self._stated
        if now - stated_at > 1:
            changed = (received, lost) != (self._heard(), self._progress.lost)
            self._put(self._write_state if changed else self._repeat_state)

    def _look_at_duty(self, now: float) -> None:
        late = self._duty.overdue(now)
        if late and self._speaks:
            self._put(partial(self._publish_confirmations, late))
        if now - self._aged_at > _UNCONFIRMED_S and self._duty.backup:
            self._aged_at = now
            self._put(self._switch.age_unconfirmed)

    def _settle(self, now: float) -> None:
        """Not while packets are published, which blocks while consumers are behind."""
        if now - self._settled_at > self._settle_s and self._publishing.acquire(blocking=False):
            try:
                self._settled_at = now
                self._outbound.settle()
            finally:
                self._publishing.release()

    def health(self) -> dict[str, Any]:
        return self._state()

    # -- from the connection ------------------------------------------------------------------

    def became_primary(self, session: P4RuntimeSession) -> None:
        if self._duty.backup:
            self._outbound.rest()
        self._put(partial(self._take_over, session))

    def became_backup(self) -> None:
        self._put(self._stand_back)

    def lost(self, cause: str) -> None:
        self._session = None
        self._put(partial(self._lose, cause))

    def packets(self, messages: list[Any]) -> None:
        with self._publishing:
            self._outbound.packets(messages)
        self._counters.packets_came()

    def digests(self, lists: list[Any]) -> None:
        learnt = [each for each in lists if each.digest_id == self._learn_id]
        if learnt:
            self._put(partial(self._learn, learnt))
            lists = [each for each in lists if each.digest_id != self._learn_id]
        if lists:
            with self._publishing:
                self._outbound.digests(lists)
        self._counters.packets_came()

    def other(self, message: Any) -> None:
        if message.WhichOneof("update") != "idle_timeout_notification":
            self._progress.malformed += 1
            return
        entries = list(message.idle_timeout_notification.table_entry)
        try:
            idle = [check_entry(entry) for entry in entries]
        except Malformed:
            self._progress.malformed += 1
            return
        self._put(partial(self._expire, idle))

    def _publish(self, key: str, value: Any, event_time: int) -> None:
        flags = [NO_WAIT] if self._settings.archive_packets else [NO_WAIT, PUB_ONLY]
        self._engine.write(key, value, flags, event_time=event_time or None)

    def _publish_counters(self, counters: RecordBatch) -> None:
        key = f"network.telemetry_counters.p4runtime_ctrl.{self.name}"
        self._engine.write(key, counters, [NO_WAIT], event_time=self._now()[0] or None)

    # -- the worker ---------------------------------------------------------------------------

    def _put(self, job: _Job) -> None:
        while not self._closing.is_set():
            try:
                self._jobs.put(job, timeout=1)
            except queue.Full:
                continue
            return

    def _work(self) -> None:
        while not (self._closing.is_set() and self._jobs.empty()):
            try:
                jobs = [self._jobs.get(timeout=0.2)]
            except queue.Empty:
                continue
            while len(jobs) < _JOBS and not self._jobs.empty():
                jobs.append(self._jobs.get())
            self._run(jobs)

    def _run(self, jobs: Sequence[_Job]) -> None:
        for job in jobs:
            if self._session is not None:  # otherwise they stay queued: the switch may connect soon
                self._decide()
            try:
                job()
            except ControllerError as error:
                _LOG.error("%s: %s", self.name, error)
                self._say(str(error))
        if self._session is not None and self._session.broken:
            self._session = None
            self._connection.break_off()

    def _take_over(self, session: P4RuntimeSession) -> None:
        self._connected = True
        self._duty.backup = False
        self._duty.settled()
        if self._was_backup:
            self._restore()
            self._was_backup = False
        began = time.monotonic()
        try:
            report = self._switch.bring_up(session)
            self.problem = ""
        except SwitchError as error:
            self.problem = str(error)
            self._connection.break_off()
            raise
        finally:
            self.settled.set()
        if report.program_loaded:
            self._progress.expect_first()
        self._brought_up_ms = (time.monotonic() - began) * 1000
        self._session = session
        self._confirm(report.confirmations)
        if self._duty.divided:
            self._follow()
        _LOG.info("%s: primary; %s", self.name, report)
        self._say(f"primary: {report}")

    def _stand_back(self) -> None:
        if self._session is not None:
            _LOG.warning("%s: another controller is primary: this one has stopped writing", self.name)
        self._connected = True
        self._was_backup = True
        self._session = None
        self._duty.stand_back()
        self.problem = ""
        if self._duty.divided:
            self._rest()
        self.settled.set()
        self._say("backup: another controller is primary")

    def _rest(self) -> None:
        """Another controller has the switch, its packets and its learnt addresses."""
        if not self._duty.granted:
            self._connection.stand(active=False)
        self._switch.forget_learnt()
        self._outbound.rest()

    def _follow(self) -> None:
        """Go on with time and numbers where the controller before had come to."""
        before, self._duty.before = self._duty.before, None
        if before is not None:
            self._outbound.follow(before.sequence)
            self._progress.time_us = max(self._progress.time_us, before.event_time // 1000)

    def _lose(self, cause: str) -> None:
        if self._connected:
            _LOG.warning("%s: connection lost: %s", self.name, cause)
            self._away_since = time.monotonic()
        self._connected = False
        self._duty.backup = False
        if not self._duty.granted:
            self._connection.stand(active=False)
        self.problem = cause
        self.settled.set()
        self._say(f"lost: {cause}")

    def _leave(self) -> None:
        if self._session is not None:
            self._switch.withdraw(self._session)

    def _decide(self) -> None:
        decisions = [self._urgent.popleft() for _ in range(len(self._urgent))]
        if decisions:
            for decision in decisions:
                self._ends.add(decision)
            self._confirm(self._switch.decide(decisions, self._session))
            self._counters.decided()
            self._say_if_none_is_left()

    def _command(self, command: TableCommand) -> None:
        self._confirm(self._switch.command(command, self._session))
        self._say_if_none_is_left()

    def _say_if_none_is_left(self) -> None:
        if self._counters.outdated:
            self._write_state()

    def _want(self, demand: Demand) -> None:
        """Unwanted keys are no longer published; new keys are, before they are requested of the switch."""
        fit, left_out = self._switch.fitting(demand.requests)
        news = [f"no telemetry {name}: {why}" for name, why in left_out.items() if name not in self._left_out]
        self._left_out = list(left_out)
        self._outbound.route(demand.only(fit))
        self._telemetry_counters.wanted = demand.counters
        for text in [*news, *self._switch.want(fit, self._session)]:
            _LOG.error("%s: %s", self.name, text)
        names = ", ".join(each.name for each in fit if each not in FALLBACK) or "nothing"
        self._say(f"telemetry: {names}" + (f"; left out: {', '.join(left_out)}" if left_out else ""))

    def _expire(self, entries: Iterable[Any]) -> None:
        if self._session is not None:
            self._confirm(self._switch.expire(entries, self._session))

    def _ask(self, batch: RecordBatch) -> None:
        questions, refused = self._packet_outs.questions(batch)
        self._sent["packet_outs_refused"] += refused
        self._send_out(questions, "cells_asked")

    def _send(self, frames: FramesToSend) -> None:
        try:
            packets = self._packet_outs.frames(frames)
        except EntryError as error:
            self._sent["packet_outs_refused"] += len(frames.ports)
            self._intake.refuse("packet_out", MessageError("range", str(error)), self.name)
            return
        self._send_out(packets, "frames_sent")

    def _pass_time(self, time_us: int) -> None:
        self._progress.time_us = max(self._progress.time_us, time_us)
        self._ends.pass_until(self._progress.time_us)
        self._write_state()

    def _say_ends(self) -> None:
        """Decisions have ended: the firewall lifts them as soon as it hears the time."""
        if self._ends.pass_until(self._progress.time_us):
            self._write_state(PUB_ONLY)

    def _send_out(self, packets: Sequence[Any], what: str) -> None:
        """Best effort, like frames; what cannot be sent is counted."""
        if self._session is None:
            self._sent["packet_outs_refused"] += len(packets) if self._speaks else 0
            return
        sent = self._session.send(packets)
        self._sent[what] += sent
        self._sent["packet_outs_refused"] += len(packets) - sent

    def _learn(self, lists: Iterable[Any]) -> None:
        if self._session is not None:
            self._switch.learn(lists, self._session)

    def _check_alive(self) -> None:
        if self._session is not None:
            self._session.alive()

    def _change_secret(self) -> None:
        self._switch.change_secret(secrets.randbits(32), secrets.randbits(32), self._session)

    @property
    def _speaks(self) -> bool:
        return self._duty.speaks(time.monotonic(), primary=self._session is not None)

    def _confirm(self, confirmations: Iterable[Confirmation]) -> None:
        if not self._speaks:
            return
        if self._duty.divided and (self._session is None or self._session.denied):
            self._duty.withhold(list(confirmations), time.monotonic())
            return
        self._publish_confirmations(confirmations)

    def _publish_confirmations(self, confirmations: Iterable[Confirmation]) -> None:
        key = f"network.confirmation.p4runtime_ctrl.{self.name}"
        waiting = list(confirmations)
        for place, confirmation in enumerate(waiting, start=1):
            flags = [NO_WAIT] if place == len(waiting) else []
            at = confirmation.event_time or None
            self._engine.write(key, confirmation.to_value(), flags, event_time=at)

    def _say(self, change: str) -> None:
        self._change = change
        self._write_state()

    def _repeat_state(self) -> None:
        """For apps that came after the last change of a silent switch; the archive has it."""
        if time.monotonic() - self._stated[-1] > 1:  # meanwhile another job may have written it
            self._write_state(PUB_ONLY)

    def _write_state(self, *flags: int) -> None:
        self._stated = (self._heard(), self._progress.lost, time.monotonic())
        if not self._speaks:
            return
        key = f"network.switch.p4runtime_ctrl.{self.name}"
        self._engine.write(key, self._state(), [NO_WAIT, *flags], event_time=self._now()[0] or None)

    def _heard(self) -> int:
        sent = sum(self._sent.values()) + self._outbound.answers + self._outbound.counts_reported
        return self._progress.received + self._progress.reported + sent

    def _state(self) -> dict[str, Any]:
        event_time, arrival = self._now()
        return {
            "switch": self.name,
            "connected": self._connected,
            "primary": self._session is not None,
            "owner": self._duty.owner(time.monotonic(), primary=self._session is not None),
            "target": self._mine.target or self._mine.address,
            "program": self._program_name,
            "base_us": self._mine.base_us,
            "clock": self._mine.clock,
            "mirror": self._mine.mirror,
            "fail": self._mine.fail,
            "telemetry": [each.name for each in self._switch.requests or () if each not in FALLBACK],
            "left_out": self._left_out,
            "packet_in": self._progress.received,
            "digests": self._progress.reported,
            "fell_back": self._outbound.fell_back,
            "skipped": self._outbound.skipped,
            "lost": self._progress.lost,
            "unaccounted": self._progress.unaccounted,
            "sequence": self._progress.sequence,
            "malformed": self._progress.malformed,
            "times_doubted": self._progress.times_doubted,
            "restarts": self._progress.restarts,
            "cells_answered": self._outbound.answers,
            "counts_reported": self._outbound.counts_reported,
            **self._sent,
            "arrival": arrival,
            "event_time": event_time,
            "blocks": self._counters.shown,
            "blocks_total": self._switch.blocks,
            **self._switch.learning,
            "change": self._change,
            "brought_up_ms": self._brought_up_ms,
        }

    def _now(self) -> tuple[int, int]:
        return self._progress.time_us * 1000, self._progress.arrival

    def _restore(self) -> None:
        """Restore the desired state from Data Archives and from items received since."""
        try:
            history = self._history.read()
        except BackendError as error:
            if not (self._was_backup and self._duty.divided):
                raise
            # every decision was heard here, too
            _LOG.warning("%s: taken over without the archive, which cannot be read: %s", self.name, error)
            return
        for each in history:
            if isinstance(each, Decision):
                self._ends.add(each)
        for problem in self._switch.restore(history):
            _LOG.warning("%s: not restored: %s", self.name, one_line(problem))


def _fail(error: Exception) -> None:
    raise error
