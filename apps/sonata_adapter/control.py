"""The adapter without I/O: from interests to entries in the switch, and from its packets to results.

keys wanted ─► requests ─► plan ─► offers (classifier bits) and entries of counting stages
packets, frames ─► merge ─► host operators ─┐
reports of counting stages ─────────────────┴─► outputs, each under the keys that requested it
"""

import secrets
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final

import msgspec

from apps.sonata_adapter.controller_updates import (
    ControllerUpdates,
    Source,
    offered,
    stream,
    updates,
    withdrawn,
)
from apps.sonata_adapter.errors import SonataError
from apps.sonata_adapter.host.engine import DEFAULT_LATENESS_US, DEFAULT_LIMIT, HostEngine, WindowEngine
from apps.sonata_adapter.host.gates import with_passed
from apps.sonata_adapter.host.merge import patience
from apps.sonata_adapter.keys import HANDSHAKE, QueryRequest, request_of
from apps.sonata_adapter.planner.cell_moves import better_places
from apps.sonata_adapter.planner.cell_needs import CellWords
from apps.sonata_adapter.planner.moves import Moves, surely_us
from apps.sonata_adapter.planner.placement import SwitchLimits
from apps.sonata_adapter.planner.plan import QueryPlan, QueryPlans, copies_saved, plan, renewed
from apps.sonata_adapter.planner.rates import MeasuredRates
from apps.sonata_adapter.planner.refinement import Crossings, Refinement, coarsest
from apps.sonata_adapter.query.catalogue import Template
from apps.sonata_adapter.query.dataflow import WindowTable, compile_query
from apps.sonata_adapter.results import Captured, Output, QueryResult
from apps.sonata_adapter.switch.cell_read import CellRead
from apps.sonata_adapter.switch.differences import Differences
from apps.sonata_adapter.switch.register_reads import RegisterReads
from apps.sonata_adapter.switch.reports import CountReportReader
from apps.sonata_adapter.switch_state import Counts, Lane, SwitchState
from due import RecordBatch
from due.errors import DueError


class Written(msgspec.Struct, frozen=True):
    """An output and the keys to write it under."""

    keys: tuple[str, ...]
    output: Output
    switch: str
    """The switch whose packets it is made from."""


WEIGH_S: Final = 2.0
"""Seconds between two looks at where queries had better run."""
MOST_KEYS: Final = 1_024
"""Most keys that are served at a time."""


class Control:
    """All decisions of the adapter.  Not thread-safe: one thread calls at a time."""

    def __init__(
        self,
        templates: Mapping[str, Template],
        *,
        limits: SwitchLimits | None = None,
        keys_limit: int = DEFAULT_LIMIT,
        lateness_us: int = DEFAULT_LATENESS_US,
        engine: Callable[..., WindowEngine] = HostEngine,
    ) -> None:
        self._templates = templates
        self._limits = limits or SwitchLimits()
        self._engine = partial(engine, limit=keys_limit, lateness_us=lateness_us)
        # what comes through a gate is little
        self._gate_engine = partial(HostEngine, limit=keys_limit, lateness_us=lateness_us)
        self._switches: dict[str, SwitchState] = {}
        self._refinement = Refinement()
        self._moves = Moves()
        self._rates = MeasuredRates()
        self._weighed_at = float("-inf")
        self._asked: dict[str, QueryRequest] = {}
        """Requests as asked for, by identity."""
        self._keys: dict[str, tuple[str, ...]] = {}
        """Keys by the identity of their request."""
        self._requests: dict[str, QueryRequest] = {}
        """The requests that are counted: the same, except for refined ones."""
        self._outputs: dict[str, tuple[str, ...]] = {}
        self._refused: dict[str, str] = {}
        self.plan = QueryPlans((), ())
        self._generation = secrets.randbelow(255)
        """Generation of the plans, random at start: an earlier adapter may have left state in the switch."""

    @property
    def requests(self) -> list[QueryRequest]:
        """The requests that are served."""
        return list(self._asked.values())

    @property
    def refused(self) -> Mapping[str, str]:
        """Keys that cannot be served, and why."""
        return self._refused

    @property
    def sources(self) -> set[Source]:
        """Streams to observe now; none when nothing is wanted."""
        found = {Source("digests", stream(bit)) for bit in self.plan.entries}
        found |= {
            Source("counts", stream(entry.count_of))
            for entry in self.plan.entries.values()
            if entry.role == "difference"
        }
        found |= {
            Source("frames" if copy.payload else "packets", stream(copy.bit)) for copy in self.plan.copies
        }
        found |= {Source("frames", stream(bit)) for bit in self.plan.gate_bits}
        return found

    def know(self, templates: Mapping[str, Template]) -> None:
        """Replace the known queries; running ones continue unchanged."""
        self._templates = templates

    @property
    def now_us(self) -> int | None:
        """Capture time reached by the switches' clocks and packets."""
        heard = [state.clock.heard_us for state in self._switches.values()]
        heard += [lane.host.watermark_us for state in self._switches.values() for lane in state.lanes]
        return max((each for each in heard if each is not None), default=None)

    def want(self, keys: Iterable[str], own: Iterable[QueryRequest] = ()) -> ControllerUpdates:
        """Replace the set of wanted keys, and of requests that the adapter has itself."""
        requests, outputs, refused = self._read(keys)
        for request in own:
            requests[request.identity] = request
            outputs[request.identity] = {request.output}
        new_refusals = tuple((key, why) for key, why in refused.items() if key not in self._refused)
        self._refused = refused
        self._asked = requests
        self._keys = {identity: tuple(sorted(found)) for identity, found in outputs.items()}
        return msgspec.structs.replace(self._planned(), refused=new_refusals)

    def refine(self) -> ControllerUpdates | None:
        """Changes because prefixes crossed the threshold or no longer do; None: no changes."""
        crossed: dict[str, set[str]] = {}
        for state in self._switches.values():
            for identity, report in state.reports.items():
                if isinstance(report, Crossings):
                    crossed.setdefault(identity, set()).update(report.crossed(state.clock.heard_us))
        return self._planned() if self._refinement.note(crossed) else None

    def measured(self, switch: str, counters: Mapping[int, int], now_us: int) -> None:
        """Take the counters of a switch's counting entries: packets by bit, at a capture time."""
        entries = self.plan.entries
        for bit, packets in counters.items():
            if bit in entries:
                self._rates.note(switch, stream(bit), entries[bit].match, packets, now_us)

    @property
    def needs_rates(self) -> bool:
        """Whether the rates of queries decide anything: one that the switch could count is on the host."""
        return any(
            not one.in_switch and copies_saved(self._requests[one.identity], self._limits) > 0
            for one in self.plan.queries
        )

    def weigh(self, now: float) -> ControllerUpdates | None:
        """Move queries where the traffic has changed, a window at a time; None: no changes."""
        if now - self._weighed_at < WEIGH_S:
            return None
        self._weighed_at = now
        self._count_copies()
        self._rates.cells.look(self.plan.entries, self._since_zero())
        changed = self._moves.end(self._since_zero())
        if not changed and not self._moves.under_way:
            better = better_places(
                self._requests.values(), self._limits, self.plan, self._rates, self._refinement.resting
            )
            for count, side in better.items():
                request = self._asked.get(self._moves.owner(count))
                if request is not None:
                    self._moves.begin(request, side, self._surely_us(request, now))
                    changed = True
        return self._planned() if changed else None

    def _count_copies(self) -> None:
        self._rates.keep(map(stream, (*self.plan.entries, *(copy.bit for copy in self.plan.copies))))
        for state in self._switches.values():
            now_us = state.clock.heard_us
            for copy in self.plan.copies if now_us is not None else ():
                lane = state.frames if copy.payload else state.headers
                packets = lane.brought.get(stream(copy.bit), 0)
                self._rates.note(state.name, stream(copy.bit), copy.match, packets, now_us or 0)

    def _since_zero(self) -> dict[str, int | None]:
        """For each switch the capture time since its clock zero."""
        return {
            name: None if state.clock.heard_us is None else state.clock.heard_us - state.base_us
            for name, state in self._switches.items()
        }

    def _surely_us(self, request: QueryRequest, now: float) -> dict[str, int]:
        """For each switch the capture time at which a count that is asked for now will be in force."""
        clocks = {name: state.clock for name, state in self._switches.items()}
        return {
            name: surely_us(heard_us, clocks[name].rate, clocks[name].idle_s(now), request.query.window_us)
            for name, heard_us in self._since_zero().items()
        }

    def everything(self) -> ControllerUpdates:
        """Everything in force, for a controller that has just started."""
        none = QueryPlans((), ())
        return ControllerUpdates(updates=updates(none, self.plan), offer=offered(none, self.plan))

    def switch(self, name: str, base_us: int) -> bool:
        """Note a switch; returns whether it is new."""
        new = name not in self._switches
        state = self._switch_state(name, base_us)
        state.base_us = base_us
        for lane in state.lanes:
            lane.host.base_us = base_us
        return new

    def packets(self, switch: str, name: str, batch: RecordBatch, now: float) -> list[Written]:
        """Copied packets of one of the sources, at `now` (seconds of any clock)."""
        state = self._switch_state(switch)
        written: list[Written] = []
        for lane in state.lanes:
            if name in lane.names:
                lane.brought[name] = lane.brought.get(name, 0) + len(batch)
                mine = with_passed(batch, passed=name == lane.opens) if lane.opens else batch
                written += self._addressed(state, lane.run(lane.merger.put(name, mine, now), now))
        return written

    def busy(self, switch: str, now: float) -> None:
        """Note that packets of a switch could not be processed until `now`, so earlier silence means nothing."""
        for lane in self._switch_state(switch).lanes:
            lane.merger.busy(now)

    def digests(self, switch: str, name: str, batch: RecordBatch) -> list[Written]:
        """Reports of counting stages."""
        state = self._switch_state(switch)
        bit = int(name[1:])
        written: list[Written] = []
        if len(batch):
            state.clock.hear(int(batch["time_us"].max()))
            self._rates.cells.reported(switch, bit, batch, self.plan.entries, state.base_us)
        for found in self.plan.queries:
            if any(entry.bit == bit for entry in found.entries) and found.identity in state.reports:
                written += self._addressed(state, state.reports[found.identity].take(bit, batch))
        return written

    def counts(self, switch: str, name: str, batch: RecordBatch, now: float) -> list[Written]:
        """Process keys whose differences are at or above the threshold at the end of a window.

        Their times move no clock: a report that was asked for carries the time that was asked about.
        """
        state = self._switch_state(switch)
        bit = int(name[1:])
        written: list[Written] = []
        for identity, report in state.reports.items():
            if isinstance(report, Differences) and self.plan.of(identity).entries[0].bit == bit:
                written += self._addressed(state, report.counted(batch, now))
        return written

    def reads(self, now: float) -> dict[str, list[CellRead]]:
        """Requests for cells of windows that have ended, by switch."""
        found: dict[str, list[CellRead]] = {}
        for name, state in self._switches.items():
            state.clock.look(now)
            for counts in state.asking:
                found.setdefault(name, []).extend(counts.due(state.clock, now))
        return {name: reads for name, reads in found.items() if reads}

    def last_reads(self, now: float) -> dict[str, list[CellRead]]:
        """Requests for cells of all open windows, by switch, after the last packet.

        Call it repeatedly while `waits_for_cells`.
        """
        found = {
            name: [read for counts in state.asking for read in counts.finish(now)]
            for name, state in self._switches.items()
        }
        return {name: reads for name, reads in found.items() if reads}

    def waits_for_cells(self, now: float) -> bool:
        """Whether an answer is outstanding."""
        return any(counts.waits(now) for state in self._switches.values() for counts in state.asking)

    @property
    def needs_cells(self) -> bool:
        """Whether such answers are expected."""
        return any(state.asking for state in self._switches.values())

    def cells(self, switch: str, numbers: Sequence[int], counts: Sequence[int]) -> list[Written]:
        """Process answers: the count for each request."""
        state = self._switch_state(switch)
        written: list[Written] = []
        for number, counted in zip(numbers, counts, strict=True):
            for each in state.asking:
                if each.waits_for(number):
                    written += self._addressed(state, each.answer(number, counted, state.clock))
        return written

    def tick(self, now: float) -> list[Written]:
        """Release packets and results that have waited long enough."""
        written: list[Written] = []
        for state in self._switches.values():
            for counts in state.asking:
                written += self._addressed(state, counts.expire(state.clock, now))
            for lane in state.lanes:
                written += self._addressed(state, lane.run(lane.merger.release(now), now))
                heard_us = state.clock.heard_us
                if heard_us is not None and lane.merger.is_quiet(now):
                    written += self._addressed(state, lane.host.advance(heard_us))
        return written

    def advance(self, switch: str, now_us: int) -> None:
        """Note that a switch's capture time has reached `now_us`, even without packets."""
        self._switch_state(switch).clock.hear(now_us)

    def set_back(self, switch: str, now_us: int) -> list[Written]:
        """A switch's clock was set back to `now_us`: what is open is reported, and all of the switch begins anew."""
        state = self._switch_state(switch)
        step_us = min(0, now_us - (state.clock.heard_us or now_us))
        written = self._addressed(state, state.set_back(now_us))
        self._moves.set_back(switch, step_us)
        self._refinement.set_back(switch, id(state), step_us)
        return written

    def renew(self) -> ControllerUpdates:
        """Changes for a switch whose clock was set back: what waits there for windows' ends would wait for far ones."""
        before = self.plan
        self._generation = 1 + self._generation % 255
        self.plan = renewed(before, self._generation)
        return ControllerUpdates(updates=updates(before, self.plan))

    def finish(self) -> list[Written]:
        """No more packets will come."""
        written: list[Written] = []
        for state in self._switches.values():
            for counts in state.asking:
                written += self._addressed(state, counts.flush())
            for lane in state.lanes:
                written += self._addressed(state, lane.run(lane.merger.flush(), None))
                written += self._addressed(state, lane.host.finish())
        return written

    def close(self) -> None:
        """Release the resources of the engines."""
        for state in self._switches.values():
            for lane in state.lanes:
                lane.host.close()

    def health(self) -> dict[str, Any]:
        """Counters for people."""
        states = self._switches.values()
        lanes = [lane for state in states for lane in state.lanes]
        return {
            "queries": {
                self._moves.owner(one.identity): "switch" if one.in_switch else f"host: {one.reason}"
                for one in self.plan.queries
            },
            "tuples": {self._moves.owner(one.identity): self._tuples(one) for one in self.plan.queries},
            "overflow": {self._moves.owner(one.identity): self._overflow(one) for one in self.plan.queries},
            "cells": {self._moves.owner(one.identity): self.cells_of(one).text for one in self.plan.queries},
            "moved": self._moves.moved,
            "bits": len(self.plan.entries) + len(self.plan.copies) + len(self.plan.gate_bits),
            "host_packets": sum(lane.host.packets for lane in lanes),
            "late": sum(lane.host.late for lane in lanes),
            "disordered": sum(lane.merger.disordered for lane in lanes),
            "without_payload": sum(lane.host.without_payload for lane in lanes),
            "reports": sum(report.tuples for state in states for report in state.reports.values()),
            "late_reads": sum(each.missed for state in states for each in state.asking),
            "open_windows": sum(each.open for state in states for each in state.asking),
            "keys": sum(map(len, self._keys.values())),
            "refused": len(self._refused),
        }

    def plan_beside(self, request: QueryRequest) -> QueryPlans:
        """The plan if one more request came now; nothing changes."""
        return plan(
            [*self._requests.values(), coarsest(request)],
            self._limits,
            before=self.plan,
            generation=self._generation,
            rates=self._rates,
        )

    def count_of(self, request: QueryRequest) -> QueryRequest:
        """The count that is in force for a request that is served; where it moves, the one that it moves from."""
        return self._requests.get(self._moves.current(request.identity), request)

    def came(self, one: QueryPlan) -> dict[str, int]:
        """What has come from the switches for a query of the plan since it is there: totals."""
        reports = [
            state.reports[one.identity] for state in self._switches.values() if one.identity in state.reports
        ]
        reported = sum(each.tuples for each in reports)
        tuples = self._tuples(one)
        return {
            "tuples": tuples,
            "reports": reported,
            "copies": tuples - reported,
            "overflow": self._overflow(one),
            "late_reads": sum(
                each.missed for each in reports if isinstance(each, (RegisterReads, Differences))
            ),
        }

    def cells_of(self, one: QueryPlan) -> CellWords:
        """The cells of a query and how many keys they have, in words."""
        return self._rates.cells.told(one.entries)

    def _tuples(self, one: QueryPlan) -> int:
        """Tuples that reached the host for a query, from all switches."""
        found = 0
        for state in self._switches.values():
            if one.identity in state.gated:
                found += sum(state.gated[one.identity].brought.values())
                continue
            lane = state.frames if one.payload else state.headers
            found += sum(lane.brought.get(stream(copy.bit), 0) for copy in one.copies)
            if one.identity in state.reports:
                found += state.reports[one.identity].tuples
        return found

    def _overflow(self, one: QueryPlan) -> int:
        """Those of them that were sent because a key had no cell."""
        reports = [state.reports.get(one.identity) for state in self._switches.values()]
        return sum(
            each.overflow
            for each in reports
            if isinstance(each, (CountReportReader, RegisterReads, Differences))
        )

    def _read(
        self, keys: Iterable[str]
    ) -> tuple[dict[str, QueryRequest], dict[str, set[str]], dict[str, str]]:
        requests: dict[str, QueryRequest] = {}
        outputs: dict[str, set[str]] = {}
        refused: dict[str, str] = {}
        for place, key in enumerate(sorted(set(keys))):
            if place >= MOST_KEYS:
                refused[key] = f"{MOST_KEYS} keys are asked for already; withdraw some"
                continue
            try:
                request = request_of(key, self._templates)
            except (SonataError, DueError) as error:
                refused[key] = str(error)
                continue
            if request is not None:
                requests.setdefault(request.identity, request)
                outputs.setdefault(request.identity, set()).add(request.output)
        return requests, outputs, refused

    def _switch_state(self, name: str, base_us: int = 0) -> SwitchState:
        state = self._switches.get(name)
        if state is None:
            state = self._switches[name] = SwitchState(name, self._engine, base_us)
            self._refit(state, {})
        return state

    def _planned(self) -> ControllerUpdates:
        """Compute the plan again and apply it."""
        before, old = self.plan, self._requests
        clocks = {name: state.clock.heard_us for name, state in self._switches.items()}
        self._generation = 1 + self._generation % 255
        while True:
            counts = self._refinement.planned(
                self._moves.counts(self._asked),
                self._limits,
                before,
                clocks,
                generation=self._generation,
                rates=self._rates,
            )
            if not self._moves.settle(self._asked, counts.plan):
                break
        self.plan, self._requests = counts.plan, counts.by_identity
        self._outputs = {
            count: self._keys[self._moves.owner(owner)] for count, owner in counts.owners.items()
        }
        for state in self._switches.values():
            self._refit(state, old)
        return ControllerUpdates(
            withdraw=withdrawn(before, self.plan),
            updates=updates(before, self.plan),
            offer=offered(before, self.plan),
        )

    def _refit(self, state: SwitchState, old: Mapping[str, QueryRequest]) -> None:
        """Adapt a switch's operators to the plan."""
        self._refit_gates(state)
        for lane in (state.headers, state.frames):
            mine = [
                one
                for one in self.plan.queries
                if not one.in_switch and one.payload == (lane is state.frames)
            ]
            host = {one.identity for one in mine}
            for identity in old.keys() - host:
                lane.host.remove(identity)
            for identity in sorted(host - lane.host.names):
                lane.host.add(self._requests[identity].query)
            lane.names = {stream(copy.bit) for one in mine for copy in one.copies}
            lane.merger.expect(lane.names)
            asked = [self._requests[one.identity] for one in mine]
            windows = [request.query.window_us for request in asked if request.kind == "query"]
            lane.merger.hurry(patience(min(windows, default=None)))
        reports: dict[str, Counts] = {}
        for one in self.plan.queries:
            if one.in_switch and one.gate is None:
                held = state.reports.get(one.identity)
                reports[one.identity] = held or self._new_reports(one, state)
        state.reports = reports

    def _refit_gates(self, state: SwitchState) -> None:
        gates = {one.identity: one.gate for one in self.plan.queries if one.gate is not None}
        for identity in state.gated.keys() - gates.keys():
            state.gated.pop(identity).host.close()
        for identity, gate in gates.items():
            lane = state.gated.get(identity)
            query = self._requests[identity].query
            if lane is None:
                lane = state.gated[identity] = Lane(self._gate_engine())
                lane.host.base_us = state.base_us
                lane.host.add(query)
            lane.opens = stream(gate.opens)
            lane.names = {lane.opens, stream(gate.uncounted)}
            lane.merger.expect(lane.names)
            lane.merger.hurry(patience(query.window_us))

    def _new_reports(self, one: QueryPlan, state: SwitchState) -> Counts:
        request = self._requests[one.identity]
        if request.coarse:
            return Crossings(request, base_us=state.base_us)
        query = request.query
        kind: type[CountReportReader | RegisterReads | Differences] = CountReportReader
        if isinstance(compile_query(query), WindowTable):
            kind = Differences if one.entries[0].role == "difference" else RegisterReads
        return kind(query, one, base_us=state.base_us, since_us=state.clock.heard_us)

    def _addressed(self, state: SwitchState, outputs: Sequence[QueryResult | Captured]) -> list[Written]:
        written: list[Written] = []
        for output in outputs:
            keys = self._outputs.get(output.query, ())
            if output.query == HANDSHAKE and isinstance(output, Captured):
                written += [
                    Written(keys, found, state.name) for found in state.handshakes.process(output.batch)
                ]
            elif isinstance(output, Captured) or (
                self._moves.accepts(output.query, state.name, output.window_us - state.base_us)
                and self._refinement.is_first(id(state), output)
            ):
                written.append(Written(keys, output, state.name))
        return written
