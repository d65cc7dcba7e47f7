"""Port forwarding: frames that enter one port leave through another."""

from collections.abc import Mapping
from typing import Any, Final

from apps.messages import TableUpdate
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo

FORWARD: Final = "ingress.forward_port"


def wires_of(program: ProgramInfo, forward: Mapping[int, int] | Mapping[str, int]) -> list[Any]:
    """Entries that forward ingress to egress ports; raises `EntryError` for a port that the program cannot express."""
    return [_wire(program, int(ingress), egress) for ingress, egress in forward.items()]


def _wire(program: ProgramInfo, ingress: int, egress: int) -> Any:
    return program.entry(
        TableUpdate(
            kind="insert",
            table=FORWARD,
            match={"ingress_port": ingress},
            action="to_port",
            params={"port": egress},
        )
    )
