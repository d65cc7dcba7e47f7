"""The firewall's own table entries in the switches: allow-list and blocked prefixes.  Pure.

Decisions about addresses and MACs are carried out by the controller; these entries are commands.  They are
archived, so that a restarted controller has them, and written again whenever a switch connects.
"""

import ipaddress
from collections.abc import Iterable
from typing import Any, Final

import msgspec

from apps.firewall.policy.rules import is_mac
from apps.messages import MessageError, TableCommand, TableUpdate, Target
from due import Item

KEPT: Final = "network.p4_command.firewall_kept"
"""`<KEPT>.<switch>`: commands that are archived."""
ALLOW: Final = "ingress.allow"
BLOCK: Final = "ingress.block"
LIMIT: Final = 1000
"""Entries of the allow table that the firewall uses; the table has room for 1,024."""
_MAC_MASK: Final = (1 << 48) - 1
_PRIORITY: Final = 10


class AllowEntries:
    """The allow-list as it is in the switches."""

    def __init__(self) -> None:
        self._written: dict[tuple[str, bytes], TableUpdate] = {}
        """By place in the table: `10.0.0.1` and `10.0.0.1/32` are one entry there."""
        self.left_out = 0
        """Entries of the list that do not fit into the table; decisions respect them nevertheless."""

    def change(self, entries: Iterable[str]) -> list[TableUpdate]:
        """Updates after which exactly these entries are allowed."""
        wanted = {_place(update): update for update in map(allow_update, entries)}
        self.left_out = max(0, len(wanted) - LIMIT)
        wanted = dict(list(wanted.items())[:LIMIT])
        updates = [_deletion(old) for place, old in self._written.items() if place not in wanted]
        updates += [new for place, new in wanted.items() if place not in self._written]
        self._written = wanted
        return updates

    def everything(self) -> list[TableUpdate]:
        """All entries, for a switch that has none of them."""
        return list(self._written.values())


def leftovers(past: Iterable[Item], wanted: Iterable[TableUpdate]) -> list[TableUpdate]:
    """Deletions of entries from archived commands that are no longer wanted."""
    held: dict[tuple[str, bytes], TableUpdate] = {}
    for item in past:
        try:
            updates = TableCommand.from_value(item.value).updates
        except MessageError:
            continue
        for update in updates:
            held.pop(_place(update), None)
            if update.kind != "delete":
                held[_place(update)] = update
    for update in wanted:
        held.pop(_place(update), None)
    return [_deletion(update) for update in held.values()]


def _place(update: TableUpdate) -> tuple[str, bytes]:
    return update.table, msgspec.json.encode(update.match, order="deterministic")


def allow_update(entry: str) -> TableUpdate:
    """An allow-list entry as an insertion; raises ValueError for a malformed one."""
    match = {"eth_src": [entry.lower(), _MAC_MASK]} if is_mac(entry) else _source(entry)
    return TableUpdate(kind="insert", table=ALLOW, match=match, action="allow_frame", priority=_PRIORITY)


def prefix_update(kind: Any, prefix: str) -> TableUpdate:
    """Insertion or deletion of a blocked prefix."""
    action = "" if kind == "delete" else "drop_frame"
    return TableUpdate(kind=kind, table=BLOCK, match=_source(prefix), action=action, priority=_PRIORITY)


def is_prefix(target: Target) -> bool:
    """Whether a block is of a prefix; the firewall writes its entries itself."""
    return target.kind == "ip" and "/" in target.address


def _source(text: str) -> dict[str, Any]:
    network = ipaddress.ip_network(text, strict=False)
    match: dict[str, Any] = {"is_ipv4": [int(network.version == 4), 1]}
    if network.prefixlen:
        match["src"] = [str(network.network_address), str(network.netmask)]
    return match


def _deletion(update: TableUpdate) -> TableUpdate:
    return TableUpdate(kind="delete", table=update.table, match=update.match, priority=update.priority)
