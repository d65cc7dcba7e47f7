"""Wires: what enters one port leaves through another."""

from collections.abc import Mapping
from typing import Any, Final

from apps.messages import TableUpdate
from apps.p4runtime_ctrl.p4info import Program

FORWARD: Final = "ingress.forward_port"


def wires_of(program: Program, forward: Mapping[int, int] | Mapping[str, int]) -> list[Any]:
    """The entries of the wires, ingress to egress port; raises `EntryError` for a port that cannot be."""
    return [_wire(program, int(ingress), egress) for ingress, egress in forward.items()]


def _wire(program: Program, ingress: int, egress: int) -> Any:
    return program.entry(
        TableUpdate(
            kind="insert",
            table=FORWARD,
            match={"ingress_port": ingress},
            action="to_port",
            params={"port": egress},
        )
    )
