"""Entries of the firewall's own in the switches, as table updates: what is allowed, and blocked prefixes.  Pure.

Decisions about addresses and MACs are carried out by the controller; these entries are commands.  They are
archived, so that a controller that begins anew has them, and written again whenever a switch comes under
control.
"""

import ipaddress
from collections.abc import Iterable
from typing import Any, Final

import msgspec

from apps.firewall.policy import is_mac
from apps.messages import TableCommand, TableUpdate, Target
from due import Item

KEPT: Final = "network.p4_command.firewall_kept"
"""`<KEPT>.<switch>`: commands that are archived."""
ALLOW: Final = "ingress.allow"
BLOCK: Final = "ingress.block"
LIMIT: Final = 1000
"""Entries of the allow table that we take; it has room for 1,024."""
_MAC_MASK: Final = (1 << 48) - 1
_PRIORITY: Final = 10


class AllowEntries:
    """The allow-list as the switches have it."""

    def __init__(self) -> None:
        self._written: dict[str, TableUpdate] = {}
        self.left_out = 0
        """Entries of the list that the table has no room for; decisions heed them all the same."""

    def change(self, entries: Iterable[str]) -> list[TableUpdate]:
        """What has to be written so that these entries are allowed, and no others."""
        wanted = {entry: allow_update(entry) for entry in entries}
        self.left_out = max(0, len(wanted) - LIMIT)
        wanted = dict(list(wanted.items())[:LIMIT])
        updates = [_deletion(old) for entry, old in self._written.items() if entry not in wanted]
        updates += [new for entry, new in wanted.items() if entry not in self._written]
        self._written = wanted
        return updates

    def everything(self) -> list[TableUpdate]:
        """All entries, for a switch that has none of them."""
        return list(self._written.values())


def leftovers(past: Iterable[Item], wanted: Iterable[TableUpdate]) -> list[TableUpdate]:
    """Deletions of what archived commands have put into switches and nobody wants any more."""
    held: dict[tuple[str, bytes], TableUpdate] = {}
    for item in past:
        try:
            updates = TableCommand.from_value(item.value).updates
        except msgspec.ValidationError:
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
    """An allow-list entry as an insertion; raises ValueError where it is none."""
    match = {"eth_src": [entry.lower(), _MAC_MASK]} if is_mac(entry) else _source(entry)
    return TableUpdate(kind="insert", table=ALLOW, match=match, action="allow_frame", priority=_PRIORITY)


def prefix_update(kind: Any, prefix: str) -> TableUpdate:
    """A blocked prefix, to be inserted or deleted."""
    action = "" if kind == "delete" else "drop_frame"
    return TableUpdate(kind=kind, table=BLOCK, match=_source(prefix), action=action, priority=_PRIORITY)


def is_prefix(target: Target) -> bool:
    """Whether a block is of a prefix, and so a command of ours."""
    return target.kind == "ip" and "/" in target.address


def _source(text: str) -> dict[str, Any]:
    network = ipaddress.ip_network(text, strict=False)
    match: dict[str, Any] = {"is_ipv4": [int(network.version == 4), 1]}
    if network.prefixlen:
        match["src"] = [str(network.network_address), str(network.netmask)]
    return match


def _deletion(update: TableUpdate) -> TableUpdate:
    return TableUpdate(kind="delete", table=update.table, match=update.match, priority=update.priority)
