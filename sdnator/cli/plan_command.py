"""`sdnator plan`: what a pipeline of some size takes, and what this machine costs a packet."""

import json
import math
import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sdnator.cli.plain_table import fitted, plain_table
from sdnator.errors import BadInput
from sdnator.plurals import counted

if TYPE_CHECKING:
    from sdnator.plan.costs import Costs
    from sdnator.plan.demand import PipelineDemand
    from sdnator.plan.model import Plan

_COSTS = Path("sdnator-costs.json")
_REMEDIES = {
    "archive (SQLite)": "use MongoDB (--archive), or ask for fewer packets",
    "switch": "use more switches, or one in hardware",
    "dashboard": "do without it (--no-dashboard)",
}
_OTHERWISE = "copy fewer packets to the controller, or divide the switches between several pipelines"
_DIVIDED = (
    'divide the switches: instances = "sharded" in [{0}], and processes = {{ {0} = 2 }} or more in [up]'
)
_DIVISIBLE = ("kitsune", "p4runtime_ctrl")
_ROOM = 0.7


def plan_command(
    *,
    switches: Annotated[int, typer.Option(help="Number of switches.")] = 1,
    pps: Annotated[
        float | None,
        typer.Option(
            help="Packets per second, at all switches together; required unless --measure is given.",
            show_default=False,
        ),
    ] = None,
    queries: Annotated[
        int, typer.Option(help="Queries in addition to those that the pipeline itself asks.")
    ] = 0,
    consumers: Annotated[int, typer.Option(help="Further apps that read every score.")] = 0,
    archive_days: Annotated[float, typer.Option(help="Days for which the archive keeps items.")] = 1.0,
    blocks: Annotated[int, typer.Option(help="Blocks in force.")] = 0,
    costs: Annotated[
        Path | None,
        typer.Option(
            help="Costs to calculate with; with --measure, where to write them.",
            metavar="FILE",
            show_default="those of the product; with --measure ./sdnator-costs.json",
        ),
    ] = None,
    measure: Annotated[
        bool, typer.Option("--measure", help="Measure this machine first (two minutes, Linux, root).")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Calculate what a pipeline needs: processes, cores, memory, archive, and what limits it.

    What a packet costs was measured: on the machine that the output names or, with --measure, on this one. The
    measurement runs a pipeline for two minutes, in a folder and on interfaces of its own; nothing else should run
    meanwhile.

    Exit codes: 0 done, 1 the measurement failed, 2 bad input or misuse.

    Example: sdnator plan --switches 200 --pps 20000 --queries 5
    """
    from sdnator.plan.demand import PipelineDemand
    from sdnator.plan.model import plan

    if pps is None and not measure:
        raise BadInput("--pps: give the number of packets a second that the pipeline has to carry")
    demand = None if pps is None else PipelineDemand(
        switches=switches, pps=pps, queries=queries, consumers=consumers, archive_days=archive_days,
        blocks=blocks,
    )  # fmt: skip
    found = _measured(costs or _COSTS) if measure else _known(costs)
    made = None if demand is None else plan(demand, found)
    if as_json:
        print(json.dumps(_as_json(made, found, demand)))
    elif demand is not None and made is not None:
        for line in shown(made, demand, found):
            print(line)


def _known(path: Path | None) -> "Costs":
    from sdnator.plan.costs import read
    from sdnator.plan.default_costs import default_costs

    return default_costs() if path is None else read(path)


def _measured(path: Path) -> "Costs":
    from sdnator.config.planned_switches import require_compiler
    from sdnator.plan.costs import write
    from sdnator.plan.measure import Schedule, measured

    if sys.platform != "linux" or os.geteuid() != 0 or shutil.which("ip") is None:
        raise BadInput(
            "--measure: the interfaces of its switches need Linux, root and the program ip (iproute2)"
        )
    require_compiler()
    if not path.absolute().parent.is_dir():
        raise BadInput(f"--costs {path}: there is no folder {path.absolute().parent}")
    found = measured(Schedule(), lambda text: print(f"sdnator: {text}", file=sys.stderr, flush=True))
    write(path, found)
    print(f"sdnator: the costs are in {path}; use them with --costs {path}", file=sys.stderr)
    return found


def shown(made: "Plan", demand: "PipelineDemand", costs: "Costs") -> Iterator[str]:
    """The lines for people."""
    rate = demand.pps / demand.switches
    more = [
        counted(number, noun)
        for number, noun in ((demand.queries, "further query"), (demand.consumers, "further consumer"))
        if number
    ]
    text = f"{counted(demand.switches, 'switch')}, {_rounded(demand.pps)} packets/s together, {_rounded(rate)} at each"
    yield fitted(", ".join((text, *more)))
    yield ""
    rows = [
        (row.name, f"{row.processes:,}", _cores(row.each), _cores(row.cores), f"{row.mib:,.0f}", ", ".join(row.grows_with))
        for row in made.rows
    ]  # fmt: skip
    rows.append(("all", f"{made.processes:,}", "", _cores(made.cores), f"{made.mib:,.0f}", ""))
    yield plain_table(("part", "processes", "cores each", "cores", "MiB", "grows with"), rows)
    yield ""
    yield f"cores to provide  {made.cores_to_provide:,}, so that bursts find room"
    yield (
        f"archive           {_rounded(made.archive_gb_per_day)} GB a day, {_rounded(made.archive_gb)} GB for "
        f"{demand.archive_days:g} day{'' if demand.archive_days == 1 else 's'}"
    )
    yield f"Data Updates      {_rounded(made.updates_in / 1e6)} MB/s in, {_rounded(made.updates_out / 1e6)} MB/s out"
    if made.keys:
        yield f"                  {made.keys:,} streams and channels"
    if made.partitions:
        yield f"                  on Kafka {made.partitions:,} partitions"
    yield ""
    yield fitted(bottleneck_sentence(made, demand.switches))
    for note in (*made.notes, basis(costs)):
        yield fitted(f"- {note}")


def bottleneck_sentence(made: "Plan", switches: int) -> str:
    """What limits the pipeline, and what to do about it."""
    found = made.bottleneck
    limit = (
        "what SQLite takes" if found.name.startswith("archive") else "one core, which is all a process uses"
    )
    remedy = _REMEDIES.get(found.name, _OTHERWISE)
    if found.name in _DIVISIBLE and switches > 1:
        remedy = _DIVIDED.format(found.name)
    if not math.isfinite(found.pps):
        where = "whatever the rate" if found.share >= 1 else "at no rate of packets"
    else:
        where = f"at about {_rounded(found.pps)} packets/s"
    if found.share >= 1:
        return f"Bottleneck: {found.name} needs {_rounded(found.share)} times {limit}, and is full {where}: {remedy}."
    room = " There is little room for bursts." if found.share > _ROOM else ""
    return f"Bottleneck: {found.name} uses {found.share:.0%} of {limit}, and is full {where}.{room}"


def basis(costs: "Costs") -> str:
    """Where the costs come from, and how far they can be trusted."""
    where = f"costs of {costs.measured} from {costs.machine}, {counted(costs.cores, 'core')}"
    note = f" ({costs.note})" if costs.note else ""
    if costs.error is None:
        return f"{where}{note}; no prediction from them was ever compared with a measurement"
    return f"{where}{note}; predictions for two and four switches were off by up to {costs.error:.0%}"


def _cores(value: float) -> str:
    return f"{value:,.1f}" if value >= 10 else f"{value:.3f}"


def _rounded(value: float) -> str:
    """Three digits, without an exponent where somebody reads it."""
    return f"{float(f'{value:.3g}'):,.0f}" if value >= 100 else f"{value:.3g}"


def _as_json(made: "Plan | None", costs: "Costs", demand: "PipelineDemand | None") -> dict[str, object]:
    import msgspec

    found = {} if made is None else asdict(made)
    if made is not None and not math.isfinite(made.bottleneck.pps):
        found["bottleneck"]["pps"] = None
    asked = {} if demand is None else {"demand": asdict(demand)}
    return {**asked, **found, "costs": msgspec.to_builtins(costs)}
