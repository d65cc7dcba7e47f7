"""Decisions of the firewall → table entries.

block   ip  → ingress.block_src      block mac on a port → ingress.block_mac
protect ip  → ingress.protect        block mac anywhere  → ingress.block
"""

import ipaddress
from typing import Any, Final

from apps.messages import Decision, TableUpdate, Target
from apps.p4runtime_ctrl.errors import EntryError, P4InfoError
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo, TableInfo

BLOCK_TABLES: Final = ("ingress.block_src", "ingress.block_mac", "ingress.block")
_ANYWHERE_PRIORITY: Final = 1


def table_update(decision: Decision, program: ProgramInfo) -> TableUpdate:
    """The update that carries out a block (insert) or unblock (delete).

    Raises `EntryError` for a target that cannot be matched, `P4InfoError` if the program's table does
    not fit.
    """
    table_name, match, priority = _sender(decision.target)
    table = program.table(table_name)
    if decision.action == "unblock":
        return TableUpdate(kind="delete", table=table.name, match=match, priority=_fit(table, priority))
    if len(table.actions) != 1 or table.actions[0].params:
        raise P4InfoError(f"{table.name}: its entries are expected to have one action without parameters")
    return TableUpdate(
        kind="insert",
        table=table.name,
        match=match,
        action=table.actions[0].name,
        priority=_fit(table, priority),
    )


def _fit(table: TableInfo, priority: int) -> int:
    return priority if table.has_priority else 0


def _sender(target: Target) -> tuple[str, dict[str, Any], int]:
    if target.kind == "ip":
        return "ingress.block_src", {"is_ipv4": _is_ipv4(target), "src": target.address}, 0
    if target.port is None:
        return "ingress.block", {"eth_src": target.address}, _ANYWHERE_PRIORITY
    return "ingress.block_mac", {"ingress_port": target.port, "eth_src": target.address}, 0


def _is_ipv4(target: Target) -> int:
    try:
        return int(ipaddress.ip_address(target.address).version == 4)
    except ValueError:
        raise EntryError(f"target {target.address!r} is not an IP address") from None
