"""MAC learning: which station is behind which port, as the switch's tables `smac` and `dmac` have it.

    learn digest ─► new station: an entry in both     moved: both modified     known: nothing
    smac silent for the age (idle time-out) ─► both entries go
    nobody learns ─► smac ignores new senders, else every frame of one would bring a digest that nobody reads

Stations are soft state: they are kept over a lost connection, and taken over from a switch that outlived
its controller.
"""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import msgspec

from apps.messages import TableUpdate
from apps.p4runtime_ctrl import values
from apps.p4runtime_ctrl.desired_state import DELETE, INSERT, MODIFY, Change, entry_key, table_id
from apps.p4runtime_ctrl.errors import ProgramError
from apps.p4runtime_ctrl.p4info import Program

DIGEST: Final = "learn_digest_t"
GROUP: Final = 1
"""Multicast group of all ports between which frames are switched."""
_SMAC, _DMAC = "ingress.smac", "ingress.dmac"
_DROP: Final = "drop_unknown"
_LEARN, _IGNORE = "learn", "ignore"
_Place = tuple[int, int]
"""VLAN (0: none) and MAC address."""


class LearnSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Switching by learnt MAC addresses, beside wires, which go first."""

    ports: tuple[int, ...]
    """Between these; frames to unknown stations go to all of them."""
    age_s: float = 300.0
    """A station that has sent nothing for so long is forgotten."""
    limit: int = 8192
    """Most stations; further ones are flooded to and counted."""


class Stations:
    """What is known of the stations of one switch.  Raises `ProgramError` where its program cannot learn."""

    def __init__(self, program: Program, settings: LearnSettings) -> None:
        members = [name for name, _ in program.digest(DIGEST)]
        missing = {"mac", "port"} - set(members)
        if missing or not {_SMAC, _DMAC} <= program.names:
            raise ProgramError(
                f"the program cannot learn MAC addresses: it has no {DIGEST}, {_SMAC} or {_DMAC}"
            )
        self._program = program
        self._settings = settings
        self._members = members
        self._ports: dict[_Place, int] = {}
        self._by_entry: dict[bytes, _Place] = {}
        self.refused = 0
        """Reports of stations beyond the limit."""
        self.moved = 0

    def __len__(self) -> int:
        return len(self._ports)

    @property
    def ports(self) -> tuple[int, ...]:
        return self._settings.ports

    def flood(self) -> Any:
        """The default action that sends frames to unknown stations to all ports."""
        update = TableUpdate(kind="modify", table=_DMAC, action="flood", params={"group": GROUP})
        return self._program.entry(update)

    def owns(self, entry: Any) -> bool:
        """Whether a learnt station has this entry."""
        return entry_key(entry) in self._by_entry

    def learn(self, lists: Iterable[Any]) -> list[Change]:
        """What reports of the switch change; the newest of a station counts."""
        seen: dict[_Place, int] = {}
        for each in lists:
            for data in each.data:
                found = (values.number(member.bitstring) for member in data.struct.members)
                row = dict(zip(self._members, found, strict=True))
                seen[row.get("vid", 0), row["mac"]] = row["port"]
        changes: list[Change] = []
        for place, port in seen.items():
            changes += self._learn(place, port)
        return changes

    def forget(self, entry: Any) -> list[Change]:
        """A station that has been silent goes, by its `smac` entry; nothing for other entries."""
        place = self._by_entry.get(entry_key(entry))
        if place is None:
            return []
        return self._drop(place)

    def undo(self, changes: Iterable[Change]) -> None:
        """The switch refused these: the stations are unknown again."""
        for change in changes:
            place = self._by_entry.get(entry_key(change.entry))
            if place is not None:
                self._drop(place)

    def adopt(self, present: Sequence[Any]) -> list[Any]:
        """Take over the stations that a switch has, when none are known here; returns their entries."""
        if self._ports:
            return []
        ports: dict[_Place, int] = {}
        smac = self._program.table(_SMAC).id
        for entry in present:
            if table_id(entry) == smac and entry.idle_timeout_ns:
                ports[self._place(entry)] = values.number(entry.action.action.params[0].value)
        kept = list(ports.items())[: self._settings.limit]
        return [change.entry for place, port in kept for change in self._learn(place, port)]

    def _place(self, entry: Any) -> _Place:
        fields = {field.id: field.name for field in self._program.tables[entry.table_id].fields}
        found = {fields[match.field_id]: values.number(match.exact.value) for match in entry.match}
        return found.get("vid", 0), found["eth_src"]

    def _learn(self, place: _Place, port: int) -> list[Change]:
        held = self._ports.get(place)
        if held == port or port not in self._settings.ports:
            return []
        if held is None and len(self._ports) >= self._settings.limit:
            self.refused += 1
            return []
        self.moved += held is not None
        self._ports[place] = port
        kind = INSERT if held is None else MODIFY
        entries = self._entries(place, port)
        self._by_entry |= {entry_key(entry): place for entry in entries}
        return [Change(kind, entry) for entry in entries]

    def _drop(self, place: _Place) -> list[Change]:
        entries = self._entries(place, self._ports.pop(place))
        for entry in entries:
            self._by_entry.pop(entry_key(entry), None)
        return [Change(DELETE, entry) for entry in entries]

    def _entries(self, place: _Place, port: int) -> list[Any]:
        """`dmac` first: a station that is known as a sender is not reported again."""
        dmac = self._update(_DMAC, place, "eth_dst", "set_egress", port, 0)
        smac = self._update(_SMAC, place, "eth_src", "known_station", port, int(self._settings.age_s * 1e9))
        return [self._program.entry(dmac), self._program.entry(smac)]

    def _update(
        self, table: str, place: _Place, key: str, action: str, port: int, idle_ns: int
    ) -> TableUpdate:
        names = {field.name for field in self._program.table(table).fields}
        match = {"vid": place[0], key: place[1]} if "vid" in names else {key: place[1]}
        return TableUpdate(
            kind="insert",
            table=table,
            match=match,
            action=action,
            params={"port": port},
            idle_timeout_ns=idle_ns,
        )


def no_flood(program: Program) -> list[Any]:
    """The default action of a switch that does not learn, where the program could."""
    return _default(program, _DMAC, _DROP)


def new_senders(program: Program, *, learn: bool) -> list[Any]:
    """What happens to frames of senders that are not known, where the program could report them."""
    return _default(program, _SMAC, _LEARN if learn else _IGNORE)


def _default(program: Program, table: str, action: str) -> list[Any]:
    actions = program.table(table).default_actions if table in program.names else ()
    if not any(each.name.rpartition(".")[2] == action for each in actions):
        return []
    return [program.entry(TableUpdate(kind="modify", table=table, action=action))]
