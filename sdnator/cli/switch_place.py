"""The switch of a command: one of the running pipeline by name, or any by address."""

from dataclasses import dataclass
from typing import Annotated

import typer

from dataplane.p4runtime.listening import is_address
from sdnator.errors import BadInput
from sdnator.up import running

SwitchArgument = Annotated[
    str,
    typer.Argument(
        help="Name in the running pipeline, HOST:PORT or unix:/PATH; default: its first switch.",
        metavar="SWITCH",
    ),
]
DeviceId = Annotated[int, typer.Option(help="P4Runtime device id, for HOST:PORT.", min=1)]


@dataclass(frozen=True)
class SwitchAddress:
    """Address at which a switch serves P4Runtime."""

    name: str
    address: str
    device_id: int


def place_of(switch: str, device_id: int) -> SwitchAddress:
    """The switch that is meant; the pipeline's first if the name is empty.

    Raises:
        BadInput: the running pipeline has no switch of that name.
        PipelineError: a name is given, or none, and no pipeline runs.
    """
    if is_address(switch):
        return SwitchAddress(switch, switch, device_id)
    found = running.need()
    known = {one["name"]: one for one in (found.switches or [found.switch])}
    if switch and switch not in known:
        raise BadInput(
            f"switch {switch}: the running pipeline has {', '.join(known)}; or give HOST:PORT or unix:/PATH"
        )
    chosen = known[switch] if switch else next(iter(known.values()))
    return SwitchAddress(chosen["name"], chosen["address"], chosen["device_id"])
