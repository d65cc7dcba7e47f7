"""The switch of a command: one of the running pipeline by name, or any by address."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dataplane.p4runtime.listening import is_address
from sdnator.config.switch_security import check, security_for
from sdnator.errors import BadInput
from sdnator.up import running

if TYPE_CHECKING:
    from p4rt import ChannelSecurity

SwitchArgument = Annotated[
    str,
    typer.Argument(
        help="Name in the running pipeline, HOST:PORT or unix:/PATH; default: its first switch.",
        metavar="SWITCH",
    ),
]
Insecure = Annotated[bool, typer.Option("--insecure", help="The switch at HOST:PORT has no TLS (for a lab).")]
DeviceId = Annotated[int, typer.Option(help="P4Runtime device id, for HOST:PORT.", min=1)]


@dataclass(frozen=True)
class SwitchAddress:
    """Address at which a switch serves P4Runtime."""

    name: str
    address: str
    device_id: int
    security: "ChannelSecurity | None" = None
    """How channels to it are secured."""


def place_of(switch: str, device_id: int, *, insecure: bool = False) -> SwitchAddress:
    """The switch that is meant; the pipeline's first if the name is empty.

    Raises:
        BadInput: the running pipeline has no switch of that name; the address needs TLS that nothing names.
        PipelineError: a name is given, or none, and no pipeline runs.
    """
    if is_address(switch):
        return SwitchAddress(switch, switch, device_id, security_for(switch, insecure=insecure))
    found = running.need()
    known = {one["name"]: one for one in (found.switches or [found.switch])}
    if switch and switch not in known:
        raise BadInput(
            f"switch {switch}: the running pipeline has {', '.join(known)}; or give HOST:PORT or unix:/PATH"
        )
    chosen = known[switch] if switch else next(iter(known.values()))
    return SwitchAddress(
        chosen["name"], chosen["address"], chosen["device_id"], check(security_in(chosen), chosen["address"])
    )


def security_in(found: Mapping[str, Any]) -> "ChannelSecurity":
    """How the running pipeline speaks with a switch of its report."""
    from p4rt import ChannelSecurity

    return ChannelSecurity(**found.get("security", {}))
