"""What changes for the controller from one plan to the next.  Pure.

Offers name bits of the classifier, updates are entries of counting stages.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import msgspec

from apps.messages import TableUpdate
from apps.sonata_adapter.planner.placement import StageEntry
from apps.sonata_adapter.planner.plan import QueryPlans


class Source(msgspec.Struct, frozen=True, order=True):
    """A stream of the controller: `network.<kind>.p4runtime_ctrl.*.<name>`."""

    kind: str
    """packets, frames, digests or counts."""
    name: str


class ControllerUpdates(msgspec.Struct, frozen=True):
    """Changes for the controller, in this order."""

    withdraw: tuple[dict[str, Any], ...] = ()
    """Offers that end."""
    updates: tuple[TableUpdate, ...] = ()
    """Entries of counting stages, for every switch."""
    offer: tuple[dict[str, Any], ...] = ()
    """Offers that begin or change."""
    refused: tuple[tuple[str, str], ...] = ()
    """Keys that cannot be served, with the reason and what is accepted."""


def withdrawn(before: QueryPlans, after: QueryPlans) -> tuple[dict[str, Any], ...]:
    """Offers that end."""
    now = {*after.entries, *after.gate_bits, *(copy.bit for copy in after.copies)}
    were = (*before.entries, *before.gate_bits, *(copy.bit for copy in before.copies))
    return tuple({"name": stream(bit), "bit": bit, "active": False} for bit in were if bit not in now)


def offered(before: QueryPlans, after: QueryPlans) -> tuple[dict[str, Any], ...]:
    """Offers that begin or change."""
    known = {entry.bit: entry.match for entry in before.entries.values()}
    found = [
        _offer(entry.bit, entry.match, copy=False)
        for entry in after.entries.values()
        if known.get(entry.bit) != entry.match
    ]
    copied = {copy.bit: copy.match for copy in before.copies}
    found += [
        _offer(copy.bit, copy.match, copy=True) for copy in after.copies if copied.get(copy.bit) != copy.match
    ]
    passed = [bit for bit in after.gate_bits if bit not in before.gate_bits]
    found += [{**_offer(bit, {}, copy=True), "by_stage": True} for bit in passed]
    return tuple(found)


def updates(before: QueryPlans, after: QueryPlans) -> tuple[TableUpdate, ...]:
    """Changes of the counting stages' entries."""
    old, new = before.entries, after.entries
    found = [_update("delete", entry) for bit, entry in old.items() if not _is_kept(new.get(bit), entry)]
    for bit, entry in sorted(new.items()):
        params = entry.params(after.repeated(bit))
        kept = _is_kept(old.get(bit), entry)
        if not kept:
            found.append(_update("insert", entry, params))
        elif old[bit] != entry or before.repeated(bit) != after.repeated(bit):
            found.append(_update("modify", entry, params))
    return tuple(found)


def stream(bit: int) -> str:
    """Last segment of the keys of a bit's packets and reports."""
    return f"q{bit}"


def _is_kept(one: StageEntry | None, other: StageEntry) -> bool:
    """Whether two entries of one bit are the same; clocks are, whatever their period."""
    return one == other or (one is not None and one.role == other.role == "clock")


def _offer(bit: int, match: Mapping[str, Any], *, copy: bool) -> dict[str, Any]:
    """A packet request."""
    return {"name": stream(bit), "bit": bit, "conditions": dict(match), "copy": copy, "active": True}


def _update(kind: Any, entry: StageEntry, params: Mapping[str, int] | None = None) -> TableUpdate:
    map_of_bit = hex(1 << entry.bit)
    return TableUpdate(
        kind=kind,
        table=f"ingress.count_{entry.stage}.queries",
        match={"query_map": [map_of_bit, map_of_bit]},
        action=f"ingress.count_{entry.stage}.{entry.action}",
        # DUE does not encode integers of more than 64 bits
        params={} if params is None else {name: hex(value) for name, value in params.items()},
        priority=1 + entry.bit,
    )


def leftovers(commands: Iterable[Sequence[TableUpdate]]) -> tuple[TableUpdate, ...]:
    """Deletions of the entries that a killed adapter's commands, oldest first, left in a switch."""
    held: dict[tuple[str, str], TableUpdate] = {}
    for updates in commands:
        for update in updates:
            key = (update.table, str(update.match))
            if update.kind == "delete":
                held.pop(key, None)
            elif update.kind == "insert":
                held[key] = update
    return tuple(msgspec.structs.replace(update, kind="delete", params={}) for update in held.values())
