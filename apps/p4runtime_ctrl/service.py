"""The P4Runtime controller: between DUE and one `SwitchWorker` per switch.

One instance is active, others stand by; or, with `instances = "sharded"`, the instances divide the switches: each of
them hears everything and has a worker for every switch, and the switch's arbitration lets one of them write.
"""

import p4rt  # noqa: F401  # isort: skip  # before anything loads gRPC: it says how gRPC waits

import logging
import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

import due.service
from apps.messages import Decision, Intake, MessageError, TableCommand, read_latest
from apps.p4runtime_ctrl.arrivals import (
    ClockReached,
    FramesToSend,
    SwitchTold,
    command_and_requests_in,
    frames_in,
    offer_in,
    questions_in,
    told_in,
)
from apps.p4runtime_ctrl.errors import ControllerError, P4InfoError
from apps.p4runtime_ctrl.settings import Settings, SwitchSettings
from apps.p4runtime_ctrl.southbound.connection import Connection
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.session import CompiledProgram, address_of
from apps.p4runtime_ctrl.state.history import DECISIONS, is_for
from apps.p4runtime_ctrl.telemetry.classifier import Classifier
from apps.p4runtime_ctrl.telemetry.demand import ALL, KINDS, Demand, Offer, Offers, demand_for, key_of
from apps.p4runtime_ctrl.watchdog import FailClosedWatchdog
from apps.p4runtime_ctrl.worker import SwitchWorker
from due import Assignment, Capability, Engine, Interest, Item, RecordBatch

INTERESTS = (
    Interest("network.block.firewall.*"),
    Interest("network.protect.firewall.*"),
    Interest("network.meter.firewall.*"),
    Interest("network.p4_command.*.*"),
    Interest("network.telemetry.*.*"),
    Interest("network.cell_request.*.*"),
    Interest("network.packet_out.*.*"),
    Interest("network.clock.*.*"),
)
SHARDED_INTERESTS = (Interest("network.switch.p4runtime_ctrl.*"),)
"""Where the instances divide the switches each hears of the others."""
CAPABILITIES = (
    Capability("network.packets.p4runtime_ctrl.*.*", delivery="reliable"),
    Capability("network.frames.p4runtime_ctrl.*.*", delivery="reliable"),
    Capability("network.digests.p4runtime_ctrl.*.*", delivery="reliable"),
    Capability("network.counts.p4runtime_ctrl.*.*", delivery="reliable"),
    Capability("network.cell.p4runtime_ctrl.*", delivery="reliable"),
    Capability("network.telemetry_counters.p4runtime_ctrl.*"),
    Capability("network.confirmation.p4runtime_ctrl.*", delivery="reliable", archive="always"),
    Capability("network.switch.p4runtime_ctrl.*", archive="always"),
)

_OFFERS: Final = "network.telemetry.*.*"
_COMMANDS: Final = "network.p4_command.*.*"
_COUNTERS: Final = "network.telemetry_counters.p4runtime_ctrl.*"
_DATA: Final = (*(key_of(kind, "*", "*") for kind in KINDS), _COUNTERS)
_LOG = logging.getLogger(__name__)
_START_S: Final = 30.0
"""For the first connections. A switch that has to compile its program takes long on a busy machine, and `up` says
afterwards that the pipeline runs."""
_OFFERS_READ: Final = 10_000
"""Most archived packet requests, and commands with such, restored at a start."""
_LOOK_EVERY_S: Final = 0.25

_T = TypeVar("_T")


class P4RuntimeCtrlService:
    """All switches of the settings.  Raises `P4InfoError` for a program that cannot be read."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._settings = settings
        self._divided = settings.instances == "sharded"
        pipeline = load_pipeline(settings)
        names = [each.name for each in settings.switches]
        if len(set(names)) != len(names):
            raise P4InfoError(f"two switches have one name: {', '.join(sorted(names))}")
        self._intake = Intake(_LOG)
        self._agents = {each.name: self._agent(each, pipeline) for each in settings.switches}
        classifier = Classifier(ProgramInfo(pipeline.p4info))
        self._offers = Offers(lambda request: classifier.entries((request,)))
        self._last_port = classifier.last_port
        self._demand = threading.Lock()
        self._asked: dict[str, Demand] = {}
        self._by_digest = {each.name: settings.by_digest(each) for each in settings.switches}
        self._watchdog = FailClosedWatchdog(settings)
        self._active = True
        self._granted: frozenset[str] = frozenset()
        """Switches that the Coordinator has given to this instance."""
        self._opened = threading.Event()
        """What came before the archive was read may be handled."""
        self._looked_at = 0.0

    def start(self) -> None:
        """Returns when every switch is connected, or its first connection attempt has failed; a standby does not wait."""
        while self._engine.health()["phase"] == "waiting" and not self._knows_its_switches():
            time.sleep(0.01)
        self._active = self._divided or bool(self._engine.health()["active"])
        if self._divided:
            # first, for a new reader gets what is written from now on; it waits until the archive is read
            self._subscribe()
            self._granted = self._engine.shards() or frozenset()
        try:
            if self._settings.restore:
                self._take_up_offers()
            self._watchdog.start()
            for agent in self._agents.values():
                agent.start(active=agent.name in self._granted if self._divided else self._active)
        finally:
            self._opened.set()
        if not self._divided:
            self._subscribe()
        self._engine.on_assignments(self._on_assignments)
        deadline = time.monotonic() + _START_S
        for agent in self._agents.values():
            if self._active:
                agent.wait_settled(deadline)

    def _subscribe(self) -> None:
        observe, reading = self._engine.observe, self._reading
        for key in DECISIONS:
            observe(key).subscribe(reading("decision", Decision.from_item, self._on_decision))
        observe(_COMMANDS).subscribe(reading("command", command_and_requests_in, self._on_command))
        observe(_OFFERS).subscribe(reading("offer", offer_in, self._on_offer))
        observe("network.cell_request.*.*").subscribe(
            reading("cell_request", questions_in, self._on_questions)
        )
        observe("network.packet_out.*.*").subscribe(reading("packet_out", frames_in, self._on_frames))
        observe("network.clock.*.*").subscribe(reading("clock", ClockReached.from_item, self._on_clock))
        for one in SHARDED_INTERESTS if self._divided else ():
            observe(one.key).subscribe(reading("switch", told_in, self._on_told))

    def _knows_its_switches(self) -> bool:
        return self._divided and self._engine.shards() is not None

    def _reading(
        self, kind: str, parse: Callable[[Item], _T], take: Callable[[Item, _T], None]
    ) -> Callable[[Item], None]:
        handle = self._intake.reading(kind, parse, take)

        def heard(item: Item) -> None:
            self._opened.wait()
            handle(item)

        return heard if self._divided else handle

    def ready(self) -> dict[str, str]:
        """For the ready line: switches that are not under control, and why."""
        if not self._active:
            return {}
        away = [f"{name}: {agent.problem}" for name, agent in self._agents.items() if agent.problem]
        return {"uncontrolled": "; ".join(away)} if away else {}

    def _agent(self, mine: SwitchSettings, pipeline: CompiledProgram) -> SwitchWorker:
        settings = self._settings
        connect = partial(
            Connection,
            address_of(settings, mine),
            pipeline,
            batch=settings.batch,
            linger_s=settings.linger_ms / 1000,
            steps_up=self._divided,
        )
        return SwitchWorker(self._engine, settings, mine, ProgramInfo(pipeline.p4info), connect, self._intake)

    def tick(self) -> None:
        for agent in self._agents.values():
            agent.tick()
        if time.monotonic() - self._looked_at > _LOOK_EVERY_S:
            self._looked_at = time.monotonic()
            self._watchdog.keep()
            self._look_at_duty()
            self._demand_changed()

    def _look_at_duty(self) -> None:
        """The active instance of this app is also the active controller of its switches."""
        if self._divided:
            self._look_at_switches()
            return
        health = self._engine.health()
        if health["asking"]:
            return  # was stopped for a moment; no takeover is known yet
        active = bool(health["active"])
        if active != self._active:
            _LOG.info("%s", "active: claiming the switches" if active else "standby: leaving the switches")
            self._active = active
            self._asked.clear()
            for agent in self._agents.values():
                agent.stand(active=active)
        elif active:
            # a standby may have stepped in while this one was away, with a clock that is ahead
            for agent in self._agents.values():
                agent.insist()

    def _look_at_switches(self) -> None:
        self._engine.offer_shards(name for name, agent in self._agents.items() if agent.within_reach)
        granted = self._engine.shards()
        if granted is None:
            return  # was stopped for a moment; nothing is known to have moved
        for name, agent in self._agents.items():
            if (name in granted) != (name in self._granted):
                _LOG.info(
                    "%s: %s", name, "given to this instance" if name in granted else "another instance's"
                )
                agent.stand(active=name in granted)
            elif name in granted:
                agent.insist()
        self._granted = granted

    def stop(self) -> None:
        for agent in self._agents.values():
            agent.stop()
        self._watchdog.dismiss()

    def health(self) -> dict[str, Any]:
        return {
            "switches": [agent.health() for agent in self._agents.values()],
            "watchdog": self._watchdog.watches,
            "offers": len(self._offers),
            **self._intake.health(),
        }

    def _on_decision(self, item: Item, decision: Decision) -> None:
        for agent in self._agents.values():
            if is_for(decision, agent.name):
                agent.decide(decision, item.timestamp)

    def _on_command(self, item: Item, told: tuple[TableCommand, str, tuple[Offer, ...]]) -> None:
        """A frame that meets a request meets the entries behind it."""
        command, app, offers = told
        agent = self._agents.get(item.key.rpartition(".")[2])
        if agent is None:
            return
        self._take_offers(item, app, [offer for offer in offers if not offer.active])
        agent.command(command, item.timestamp)
        self._take_offers(item, app, [offer for offer in offers if offer.active])

    def _take_offers(self, item: Item, app: str, offers: Sequence[Offer]) -> None:
        for offer in offers:
            self._take_offer(item, (app, offer))
        if offers:
            self._demand_changed()

    def _on_questions(self, item: Item, questions: RecordBatch) -> None:
        agent = self._agents.get(item.key.rpartition(".")[2])
        if agent is not None:
            agent.ask(questions)

    def _on_frames(self, item: Item, frames: FramesToSend) -> None:
        agent = self._agents.get(item.key.rpartition(".")[2])
        if agent is not None:
            agent.send(frames)

    def _on_clock(self, item: Item, reached: ClockReached) -> None:
        agent = self._agents.get(item.key.rpartition(".")[2])
        if agent is not None:
            agent.clock_reached(reached.event_time)

    def _on_told(self, item: Item, told: SwitchTold) -> None:
        agent = self._agents.get(told.switch)
        if agent is not None and item.instance_id != self._engine.instance_id:
            agent.told(told, item.instance_id)

    def _on_offer(self, item: Item, offered: tuple[str, Offer]) -> None:
        self._take_offer(item, offered)
        self._demand_changed()

    def _take_offer(self, item: Item, offered: tuple[str, Offer]) -> None:
        try:
            with self._demand:
                self._offers.take(*offered)
        except MessageError as error:
            self._intake.refuse("offer", error, item.key)

    def _take_up_offers(self) -> None:
        query, since = {"dataKey": _OFFERS}, self._settings.restore_since
        take = self._intake.reading("offer", offer_in, self._take_offer)
        for item in read_latest(self._engine, query, since, _OFFERS_READ):
            take(item)
        take = self._intake.reading("command", command_and_requests_in, self._take_requests)
        for item in read_latest(self._engine, {"dataKey": _COMMANDS}, since, _OFFERS_READ):
            take(item)

    def _take_requests(self, item: Item, told: tuple[TableCommand, str, tuple[Offer, ...]]) -> None:
        """Those of an archived command, whose updates the switches' workers take up."""
        _, app, offers = told
        if item.key.rpartition(".")[2] in self._agents:
            for offer in offers:
                self._take_offer(item, (app, offer))

    def _on_assignments(self, _: tuple[Assignment, ...]) -> None:
        self._demand_changed()
        for agent in self._agents.values():
            agent.say_again()

    def _demand_changed(self) -> None:
        """Pass the demand to the workers; without a Coordinator, demand for everything.

        A standby instance gets no demand, and leaves the switches' telemetry as it is; so does one
        that was stopped for a moment: frames that pass while it asks who is active are still wanted.
        """
        if not self._active:
            return
        with self._demand:
            keys = tuple(each.key for each in self._engine.assignments() if each.capability in _DATA)
            if not keys and not self._engine.health()["active"]:
                return
            for name, agent in self._agents.items():
                everything = key_of("packets", name, ALL)
                wanted = (*keys, everything) if self._engine.wanted(everything) else keys
                demand = demand_for(
                    name,
                    wanted,
                    self._offers,
                    by_digest=self._by_digest[name],
                    last_port=self._last_port,
                )
                if demand != self._asked.get(name):
                    self._asked[name] = demand
                    agent.want(demand)


def load_pipeline(settings: Settings) -> CompiledProgram:
    """The compiled program; raises `P4InfoError` naming the file that cannot be read."""
    try:
        config = Path(settings.program).read_bytes()
        text = Path(settings.p4info).read_text(encoding="utf-8")
    except OSError as error:
        raise P4InfoError(
            f"{error.filename}: {error.strerror}; compile the P4 program or give its path"
        ) from error
    return CompiledProgram(config, ProgramInfo.from_text(text).message)


def main(argv: Sequence[str] | None = None) -> int:
    try:
        return due.service.run(
            "p4runtime_ctrl",
            P4RuntimeCtrlService,
            Settings,
            INTERESTS,
            CAPABILITIES,
            argv,
            shards=lambda settings: [each.name for each in settings.switches],
        )
    except P4InfoError as error:
        _LOG.error("%s", error)
        return 2
    except ControllerError as error:
        _LOG.critical("the controller ends: %s", error)
        return 1


if __name__ == "__main__":
    sys.exit(main())
