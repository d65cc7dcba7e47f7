"""Which switch a command means: one of the running pipeline by its name, or any by HOST:PORT."""

from dataclasses import dataclass
from typing import Annotated

import typer

from sdnator import running
from sdnator.errors import BadInput

SwitchArgument = Annotated[
    str,
    typer.Argument(
        help="Name in the running pipeline, or HOST:PORT; default: the pipeline's.", metavar="SWITCH"
    ),
]
DeviceId = Annotated[int, typer.Option(help="P4Runtime device id, for HOST:PORT.", min=1)]


@dataclass(frozen=True)
class Place:
    """Where a switch serves P4Runtime."""

    name: str
    address: str
    device_id: int


def place_of(switch: str, device_id: int) -> Place:
    """The switch that is meant; the pipeline's first where the name is empty.

    Raises:
        BadInput: the running pipeline has no switch of that name.
        PipelineError: a name is given, or none, and no pipeline runs.
    """
    host, _, port = switch.rpartition(":")
    if host and port.isdecimal():
        return Place(switch, switch, device_id)
    found = running.need()
    known = {one["name"]: one for one in (found.switches or [found.switch])}
    if switch and switch not in known:
        raise BadInput(f"switch {switch}: the running pipeline has {', '.join(known)}; or give HOST:PORT")
    chosen = known[switch] if switch else next(iter(known.values()))
    return Place(chosen["name"], chosen["address"], chosen["device_id"])
