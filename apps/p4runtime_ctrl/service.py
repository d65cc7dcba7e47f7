"""The P4Runtime controller: between DUE and one agent per switch."""

import p4rt  # noqa: F401  # isort: skip  # before anything loads gRPC: it says how gRPC waits

import logging
import sys
import threading
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import due.service
from apps.messages import Decision, TableCommand
from apps.p4runtime_ctrl.agent import Agent
from apps.p4runtime_ctrl.connection import Connection
from apps.p4runtime_ctrl.demand import ALL, KINDS, Demand, Offer, demand_for, key_of
from apps.p4runtime_ctrl.errors import ProgramError
from apps.p4runtime_ctrl.history import DECISIONS, is_for, read
from apps.p4runtime_ctrl.p4info import Program
from apps.p4runtime_ctrl.sentinel import Sentinel
from apps.p4runtime_ctrl.session import Pipeline, address_of
from apps.p4runtime_ctrl.settings import Settings, SwitchSettings
from due import Assignment, Capability, Engine, Interest, Item

INTERESTS = (
    Interest("network.block.firewall.*"),
    Interest("network.protect.firewall.*"),
    Interest("network.p4_command.*.*"),
    Interest("network.telemetry.*.*"),
    Interest("network.cell_request.*.*"),
    Interest("network.packet_out.*.*"),
)
CAPABILITIES = (
    Capability("network.packets.p4runtime_ctrl.*.*", delivery="reliable"),
    Capability("network.frames.p4runtime_ctrl.*.*", delivery="reliable"),
    Capability("network.digests.p4runtime_ctrl.*.*", delivery="reliable"),
    Capability("network.counts.p4runtime_ctrl.*.*", delivery="reliable"),
    Capability("network.cell.p4runtime_ctrl.*", delivery="reliable"),
    Capability("network.confirmation.p4runtime_ctrl.*", delivery="reliable", archive="always"),
    Capability("network.switch.p4runtime_ctrl.*", archive="always"),
)

_OFFERS: Final = "network.telemetry.*.*"
_DATA: Final = tuple(key_of(kind, "*", "*") for kind in KINDS)
_LOG = logging.getLogger(__name__)
_START_S: Final = 10.0
_LOOK_EVERY_S: Final = 0.25


class P4RuntimeCtrlService:
    """All switches of the settings.  Raises `ProgramError` for a program that cannot be read."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._settings = settings
        pipeline = load_pipeline(settings)
        names = [each.name for each in settings.switches]
        if len(set(names)) != len(names):
            raise ProgramError(f"two switches have one name: {', '.join(sorted(names))}")
        self._agents = {each.name: self._agent(each, pipeline) for each in settings.switches}
        self._offers: dict[str, Offer] = {}
        self._demand = threading.Lock()
        self._asked: dict[str, Demand] = {}
        self._by_digest = settings.telemetry == "digest"
        self._sentinel = Sentinel(settings)
        self._chief = True
        self._looked_at = 0.0

    def start(self) -> None:
        """Returns when every switch is under control, or could not be reached at the first attempt."""
        while self._engine.health()["phase"] == "waiting":
            time.sleep(0.01)
        self._chief = bool(self._engine.health()["active"])
        for item in self._engine.get(_OFFERS) if self._settings.restore else ():
            if item.timestamp > self._settings.restore_since:
                self._take_offer(item)
        self._sentinel.start()
        for agent in self._agents.values():
            agent.start(chief=self._chief)
        for key in DECISIONS:
            self._engine.observe(key).subscribe(self._on_decision)
        self._engine.observe("network.p4_command.*.*").subscribe(self._on_command)
        self._engine.observe(_OFFERS).subscribe(self._on_offer)
        self._engine.observe("network.cell_request.*.*").subscribe(self._on_questions)
        self._engine.observe("network.packet_out.*.*").subscribe(self._on_frames)
        self._engine.on_assignments(self._on_assignments)
        deadline = time.monotonic() + _START_S
        for agent in self._agents.values():
            agent.settled.wait(max(0.0, deadline - time.monotonic()))

    def _agent(self, mine: SwitchSettings, pipeline: Pipeline) -> Agent:
        settings = self._settings
        connect = partial(
            Connection,
            address_of(settings, mine),
            pipeline,
            batch=settings.batch,
            linger_s=settings.linger_ms / 1000,
        )
        return Agent(self._engine, settings, mine, Program(pipeline.p4info), connect)

    def tick(self) -> None:
        for agent in self._agents.values():
            agent.tick()
        if time.monotonic() - self._looked_at > _LOOK_EVERY_S:
            self._looked_at = time.monotonic()
            self._sentinel.keep()
            self._look_at_duty()
            self._demand_changed()

    def _look_at_duty(self) -> None:
        """DUE says which instance of this app works; that one is the chief of its switches, too."""
        health = self._engine.health()
        if health["asking"]:
            return  # stopped for a moment: nobody has taken over yet, as far as anybody knows
        chief = bool(health["active"])
        if chief != self._chief:
            _LOG.info("%s", "active: claiming the switches" if chief else "standby: leaving the switches")
            self._chief = chief
            self._asked.clear()
            for agent in self._agents.values():
                agent.stand(chief=chief)

    def stop(self) -> None:
        for agent in self._agents.values():
            agent.stop()
        self._sentinel.dismiss()

    def health(self) -> dict[str, Any]:
        return {
            "switches": [agent.health() for agent in self._agents.values()],
            "sentinel": self._sentinel.watches,
        }

    def _on_decision(self, item: Item) -> None:
        decision = read(Decision, item)
        if decision is None:
            return
        for agent in self._agents.values():
            if is_for(decision, agent.name):
                agent.decide(decision)

    def _on_command(self, item: Item) -> None:
        agent = self._agents.get(item.key.rpartition(".")[2])
        command = read(TableCommand, item) if agent is not None else None
        if agent is not None and command is not None:
            agent.command(command)

    def _on_questions(self, item: Item) -> None:
        agent = self._agents.get(item.key.rpartition(".")[2])
        if agent is not None:
            agent.ask(item.value)

    def _on_frames(self, item: Item) -> None:
        agent = self._agents.get(item.key.rpartition(".")[2])
        if agent is not None:
            agent.send(item.value)

    def _on_offer(self, item: Item) -> None:
        self._take_offer(item)
        self._demand_changed()

    def _take_offer(self, item: Item) -> None:
        offer = read(Offer, item)
        if offer is not None:
            with self._demand:
                self._offers[offer.name] = offer

    def _on_assignments(self, _: tuple[Assignment, ...]) -> None:
        self._demand_changed()
        for agent in self._agents.values():
            agent.say_again()

    def _demand_changed(self) -> None:
        """Tell agents what is wanted of them; everything while no Coordinator is there to ask.

        A standby instance is told nothing of demand, and leaves the switches' telemetry as it is; so does one
        that was stopped for a moment: frames that pass while it asks who is active are wanted all the same.
        """
        if not self._chief:
            return
        with self._demand:
            keys = tuple(each.key for each in self._engine.assignments() if each.capability in _DATA)
            if not keys and not self._engine.health()["active"]:
                return
            for name, agent in self._agents.items():
                everything = key_of("packets", name, ALL)
                wanted = (*keys, everything) if self._engine.wanted(everything) else keys
                demand = demand_for(name, wanted, self._offers, by_digest=self._by_digest)
                if demand != self._asked.get(name):
                    self._asked[name] = demand
                    agent.want(demand)


def load_pipeline(settings: Settings) -> Pipeline:
    """The compiled program; raises `ProgramError` naming the file that cannot be read."""
    try:
        config = Path(settings.program).read_bytes()
        text = Path(settings.p4info).read_text(encoding="utf-8")
    except OSError as error:
        raise ProgramError(
            f"{error.filename}: {error.strerror}; compile the P4 program or give its path"
        ) from error
    return Pipeline(config, Program.from_text(text).message)


def main(argv: Sequence[str] | None = None) -> int:
    try:
        return due.service.run(
            "p4runtime_ctrl", P4RuntimeCtrlService, Settings, INTERESTS, CAPABILITIES, argv
        )
    except ProgramError as error:
        _LOG.error("%s", error)
        return 2


if __name__ == "__main__":
    sys.exit(main())
