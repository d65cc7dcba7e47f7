"""Packet requests → entries of a switch's bit-vector classifier.

One table per field gives the map of requests whose condition on that field holds; the switch ANDs
the maps and masks them with `active`.  A table gives one match only, so an entry carries the bits of
every wider entry that covers it, and if two conditions overlap their intersection gets its own entry
(`match_regions` has the geometry).

A request is installed with its field entries first and its `active` bit last, and removed in the reverse
order, so that no packet meets half a request.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final

import msgspec

from apps.messages import TableUpdate
from apps.p4runtime_ctrl.errors import EntryError, P4InfoError, TelemetryError
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo, TableInfo
from apps.p4runtime_ctrl.state.desired_state import (
    DELETE,
    INSERT,
    MODIFY,
    Change,
    EntrySet,
    difference,
    entry_body,
)
from apps.p4runtime_ctrl.telemetry.match_regions import Closure, Covering, MatchRegion, Shape

EVERY_PACKET: Final = 255
"""The classifier's bit of the request for all packets; per-port requests count down from it."""
QUERIES: Final = 256
_ACTIVE: Final = "ingress.telemetry_active"
_PREFIX: Final = "ingress.telemetry_"
_MAPS: Final = ("active", "copies", "digests")


class TelemetryRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A packet request: packets that meet all conditions.

    Conditions go by match field of the classifier, in the notation of `apps.messages.TableUpdate`
    (`{"src": "10.0.0.0/8", "dport": [80, 90], "tcp_flags": [2, 23]}`); none means every packet.
    """

    name: str
    """Last segment of the key under which the packets are published."""
    bit: int
    """0 to 255, unlike that of any other request."""
    conditions: dict[str, Any] = {}
    copy: bool = True
    """Send packet-ins of the matching packets; otherwise they are only counted."""
    digest: bool = False
    by_stage: bool = False
    """The packets are chosen and copied by a counting stage: the bit has no entries here."""


class Classifier:
    """The telemetry tables of a program.  Raises `P4InfoError` where it has none."""

    def __init__(self, program: ProgramInfo) -> None:
        self._program = program
        self._active = _find(program, _ACTIVE)
        self._tables = [
            table
            for table in program.tables.values()
            if table.name.startswith(_PREFIX) and table.name != _ACTIVE
        ]
        for table in self._tables:
            if len(table.actions) != 1 or len(table.actions[0].params) != 1:
                raise P4InfoError(f"{table.name}: one action with the map of queries is expected")
        taken = [param.name for param in self._active.default_actions[0].params]
        if sorted(taken) != sorted(_MAPS):
            raise P4InfoError(f"{_ACTIVE}: its action takes {', '.join(taken)}, not {', '.join(_MAPS)}")
        self._shapes = {table.id: Shape(table) for table in self._tables}
        self._closures = {table.id: Closure(limit=table.size, where=table.name) for table in self._tables}
        self.table_ids = frozenset(table.id for table in (*self._tables, self._active))

    @property
    def last_port(self) -> int:
        """The highest ingress port that a condition can name; -1 if the program matches none."""
        fields = (field for table in self._tables for field in table.fields)
        return max(((1 << field.width) - 1 for field in fields if field.name == "ingress_port"), default=-1)

    def fitting(self, requests: Sequence[TelemetryRequest]) -> tuple[list[TelemetryRequest], dict[str, str]]:
        """The requests that the tables can hold together, earlier ones first; and why each of the others is left out.

        Returns:
            Those that fit, in their order; name to reason of the others.
        """
        with suppress(EntryError, TelemetryError):
            self._check(requests)
            return list(requests), {}
        fit: list[TelemetryRequest] = []
        left_out: dict[str, str] = {}
        given: list[dict[int, MatchRegion]] = []
        for request in requests:
            try:
                _check_bits([*fit, request])
                more = given if request.by_stage else [*given, self._assign(request)]
                self._hold(more)
            except (EntryError, TelemetryError) as error:
                left_out[request.name] = str(error)
            else:
                fit.append(request)
                given = more
        return fit, left_out

    def entries(self, requests: Sequence[TelemetryRequest]) -> EntrySet:
        """All entries and default actions that the requests need.

        Raises `TelemetryError` where two requests share a bit or a table is too small, `EntryError`
        for a condition that the classifier cannot express.
        """
        conditions = self._check(requests)
        requests = [request for request in requests if not request.by_stage]
        found = EntrySet([self._active_entry(requests)])
        for table in self._tables:
            regions = [given.get(table.id) for given in conditions]
            self._fill(found, table, list(zip(requests, regions, strict=True)))
        return found

    def transition(
        self, present: EntrySet, desired: EntrySet, kept: Sequence[TelemetryRequest]
    ) -> list[Change]:
        """Steps from what the switch holds to the `entries` of some requests, to be written in this order.

        `kept` are the requests that stay unchanged and must not miss a packet.
        """
        fields = difference(self._without_active(desired), self._without_active(present), rank=_outside_in)
        goal = desired.get(self._active_entry(()))
        pause = self._active_entry(kept) if fields else goal
        changes = list(fields)
        held = present.get(goal)
        if held is None or entry_body(held) != entry_body(pause):
            changes.insert(0, Change(MODIFY, pause))
        if entry_body(pause) != entry_body(goal):
            changes.append(Change(MODIFY, goal))
        return changes

    def _without_active(self, entries: EntrySet) -> EntrySet:
        return EntrySet(entry for entry in entries if entry.table_id != self._active.id)

    def _active_entry(self, requests: Iterable[TelemetryRequest]) -> Any:
        chosen = [request for request in requests if not request.by_stage]
        maps = {
            "active": _map(chosen),
            "copies": _map(request for request in chosen if request.copy),
            "digests": _map(request for request in chosen if request.digest),
        }
        action = self._active.default_actions[0]
        update = TableUpdate(kind="modify", table=self._active.name, action=action.name, params=maps)
        return self._program.entry(update)

    def _check(self, requests: Sequence[TelemetryRequest]) -> list[dict[int, MatchRegion]]:
        """Conditions by table, of each request that has some here; raises as `entries` does."""
        _check_bits(requests)
        conditions = [self._assign(request) for request in requests if not request.by_stage]
        self._hold(conditions)
        return conditions

    def _hold(self, conditions: Sequence[Mapping[int, MatchRegion]]) -> None:
        """Raises `TelemetryError` where a table is too small for them."""
        for table in self._tables:
            self._closures[table.id].of(given[table.id] for given in conditions if table.id in given)

    def _assign(self, request: TelemetryRequest) -> dict[int, MatchRegion]:
        """Conditions of a request by table; one that fits several tables goes to the first."""
        given: dict[int, dict[str, Any]] = {}
        for name, value in request.conditions.items():
            table = next((table for table in self._tables if name in (f.name for f in table.fields)), None)
            if table is None:
                known = sorted({field.name for table in self._tables for field in table.fields})
                raise EntryError(
                    f"request {request.name}: no condition {name!r}; there are {', '.join(known)}"
                )
            given.setdefault(table.id, {})[name] = value
        return {table_id: self._shapes[table_id].region(match) for table_id, match in given.items()}

    def _fill(
        self, found: EntrySet, table: TableInfo, wanted: list[tuple[TelemetryRequest, MatchRegion | None]]
    ) -> None:
        action = table.actions[0]
        name = action.params[0].name
        everywhere = [request for request, region in wanted if region is None]

        def update(
            match: Mapping[str, Any], bits: int, priority: int = 0, *, default: bool = False
        ) -> TableUpdate:
            kind: Any = "modify" if default else "insert"
            return TableUpdate(
                kind=kind,
                table=table.name,
                match=dict(match),
                action=action.name,
                params={name: bits},
                priority=priority,
            )

        found.put(self._program.entry(update({}, _map(everywhere), default=True)))
        shape = self._shapes[table.id]
        everywhere_bits = _map(everywhere)
        bits: dict[MatchRegion, int] = {}
        for request, region in wanted:
            if region is not None:
                bits[region] = bits.get(region, 0) | 1 << request.bit
        covering = Covering(bits)
        for region in self._closures[table.id].of(bits):
            priority = shape.priority(region) if table.has_priority else 0
            entry = update(shape.match(region), everywhere_bits | covering.bits(region), priority)
            found.put(self._program.entry(entry))


def _find(program: ProgramInfo, name: str) -> TableInfo:
    try:
        return program.table(name)
    except EntryError as error:
        raise P4InfoError(f"the program has no telemetry: {error}") from error


def _map(requests: Iterable[TelemetryRequest]) -> int:
    bits = 0
    for request in requests:
        bits |= 1 << request.bit
    return bits


def _check_bits(requests: Sequence[TelemetryRequest]) -> None:
    taken: dict[int, str] = {}
    for request in requests:
        if not 0 <= request.bit < QUERIES:
            raise TelemetryError(f"request {request.name}: bit {request.bit} is not within 0..{QUERIES - 1}")
        if request.bit in taken:
            raise TelemetryError(f"requests {taken[request.bit]} and {request.name} share bit {request.bit}")
        taken[request.bit] = request.name


def _outside_in(change: Change) -> tuple[int, int]:
    """Narrow entries are inserted first and deleted last, so that no packet matches a wider one meanwhile."""
    narrow = sum(match.lpm.prefix_len for match in change.entry.match) + change.entry.priority
    if change.kind == INSERT:
        return 0, -narrow
    return (1, 0) if change.kind != DELETE else (2, narrow)
