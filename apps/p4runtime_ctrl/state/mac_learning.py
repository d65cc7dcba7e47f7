"""MAC learning: which MAC address is behind which port, as entries of the tables `smac` and `dmac`.

    learn digest ─► new address: an entry in both     moved: both modified     known: nothing
    smac entry idle for `age_s` (idle time-out) ─► both entries are removed
    learning off ─► smac ignores new senders, so that their frames cause no digests

Learnt addresses are soft state: they are kept over a lost connection, and read from a switch that outlived
its controller.
"""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import msgspec

from apps.messages import TableUpdate
from apps.p4runtime_ctrl.errors import P4InfoError
from apps.p4runtime_ctrl.southbound import values
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.state.desired_state import DELETE, INSERT, MODIFY, Change, entry_key, table_id

DIGEST: Final = "learn_digest_t"
GROUP: Final = 1
"""Multicast group of all ports between which frames are switched."""
_SMAC, _DMAC = "ingress.smac", "ingress.dmac"
_DROP: Final = "drop_unknown"
_LEARN, _IGNORE = "learn", "ignore"
_MAC_BYTES: Final = 6
_VLANS: Final = 4096
_Place = tuple[int, int]
"""VLAN (0: none) and MAC address."""


class LearnSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Switching by learnt MAC addresses; port forwarding takes precedence."""

    ports: tuple[int, ...]
    """Ports that learn; frames to unknown addresses are flooded to all of them."""
    age_s: float = 300.0
    """Seconds without a frame after which a learnt MAC address is removed."""
    limit: int = 8192
    """Most MAC addresses to learn; frames to further ones are flooded."""


class MacLearning:
    """Learnt MAC addresses of one switch.  Raises `P4InfoError` if its program cannot learn."""

    def __init__(self, program: ProgramInfo, settings: LearnSettings) -> None:
        members = [name for name, _ in program.digest(DIGEST)]
        missing = {"mac", "port"} - set(members)
        if missing or not {_SMAC, _DMAC} <= program.names:
            raise P4InfoError(
                f"the program cannot learn MAC addresses: it has no {DIGEST}, {_SMAC} or {_DMAC}"
            )
        self._program = program
        self._settings = settings
        self._members = members
        self._ports: dict[_Place, int] = {}
        self._by_entry: dict[bytes, _Place] = {}
        self.refused = 0
        """Reports of MAC addresses beyond the limit."""
        self.moved = 0
        self.malformed = 0
        """Malformed reports."""

    def __len__(self) -> int:
        return len(self._ports)

    @property
    def ports(self) -> tuple[int, ...]:
        return self._settings.ports

    def flood(self) -> Any:
        """The default action that floods frames to unknown addresses to all ports."""
        update = TableUpdate(kind="modify", table=_DMAC, action="flood", params={"group": GROUP})
        return self._program.entry(update)

    def owns(self, entry: Any) -> bool:
        """Whether this entry belongs to a learnt address."""
        return entry_key(entry) in self._by_entry

    def learn(self, lists: Iterable[Any]) -> list[Change]:
        """Changes from reports of the switch; the newest report of an address counts."""
        seen: dict[_Place, int] = {}
        for each in lists:
            for data in each.data:
                row = self._row(data.struct.members)
                if row is None:
                    self.malformed += 1
                else:
                    seen[row.get("vid", 0), row["mac"]] = row["port"]
        changes: list[Change] = []
        for place, port in seen.items():
            changes += self._learn(place, port)
        return changes

    def _row(self, members: Sequence[Any]) -> dict[str, int] | None:
        """The fields of a report; None if it has others, or a value does not fit."""
        if len(members) != len(self._members) or any(len(each.bitstring) > _MAC_BYTES for each in members):
            return None
        found = (values.number(member.bitstring) for member in members)
        row = dict(zip(self._members, found, strict=True))
        return row if row.get("vid", 0) < _VLANS else None

    def forget(self, entry: Any) -> list[Change]:
        """Changes that remove an idle address, given its `smac` entry; none for other entries."""
        place = self._by_entry.get(entry_key(entry))
        if place is None:
            return []
        return self._drop(place)

    def forget_all(self) -> list[Change]:
        """Forget every address; returns the changes that would remove them."""
        return [change for place in list(self._ports) for change in self._drop(place)]

    def undo(self, changes: Iterable[Change]) -> None:
        """The switch refused these changes: their addresses are unknown again."""
        for change in changes:
            place = self._by_entry.get(entry_key(change.entry))
            if place is not None:
                self._drop(place)

    def adopt(self, present: Sequence[Any]) -> list[Any]:
        """Adopt the addresses in a switch's entries if none are known here; returns their entries."""
        if self._ports:
            return []
        ports: dict[_Place, int] = {}
        smac = self._program.table(_SMAC).id
        for entry in present:
            place = self._place(entry) if table_id(entry) == smac and entry.idle_timeout_ns else None
            if place is not None:
                ports[place] = values.number(entry.action.action.params[0].value)
        kept = list(ports.items())[: self._settings.limit]
        return [change.entry for place, port in kept for change in self._learn(place, port)]

    def _place(self, entry: Any) -> _Place | None:
        """VLAN and MAC address of a switch's entry; None for other entries."""
        fields = {field.id: field.name for field in self._program.tables[entry.table_id].fields}
        found = {fields.get(match.field_id): values.number(match.exact.value) for match in entry.match}
        if "eth_src" not in found or not entry.action.action.params:
            return None
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
        """`dmac` first: an address in `smac` is not reported again."""
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


def no_flood(program: ProgramInfo) -> list[Any]:
    """The default action of a switch that does not learn, if its program can."""
    return _default(program, _DMAC, _DROP)


def new_senders(program: ProgramInfo, *, learn: bool) -> list[Any]:
    """The default action for frames of unknown senders, if the program can report them."""
    return _default(program, _SMAC, _LEARN if learn else _IGNORE)


def _default(program: ProgramInfo, table: str, action: str) -> list[Any]:
    actions = program.table(table).default_actions if table in program.names else ()
    if not any(each.name.rpartition(".")[2] == action for each in actions):
        return []
    return [program.entry(TableUpdate(kind="modify", table=table, action=action))]
