"""How well `sdnator plan` predicts: `python -m benchmarks.cluster_plan --json FILE`.

    one switch at two rates, before and after ─► costs ─► prediction ─┐
    two, then four, same traffic at each ─► /proc ────────────────────┴─► plan_error

Pipelines of `sdnator up` with embedded switches between veth pairs, one after the other; load for seconds.
`plan_error`: the largest relative difference between prediction and measurement, of cores and of bytes archived a
day, at both sizes.  Predicted cores are for a machine as fast as it was while two and four switches were measured,
which a fixed piece of work tells (`sdnator.plan.reference_work`): CPU time of the same packets differs by a third
within minutes.  `plan_error_unscaled` is without that.  `--costs FILE` writes the costs of this machine for
`sdnator plan --costs`, with the larger of the two errors, since a plan does not know what speed there will be.
Takes about six minutes, with `--costs` eight; the machine must be quiet.  Linux, root.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msgspec import to_builtins
from msgspec.structs import replace

from benchmarks.measure import machine, table, write_json
from sdnator.errors import SdnatorError
from sdnator.plan.costs import Costs, ProcessCost, write
from sdnator.plan.demand import PipelineDemand
from sdnator.plan.measure import TRAIN_S, Schedule, measured, one_switch, over_idle
from sdnator.plan.measured_pipeline import LoadPhase, MeasuredPipeline
from sdnator.plan.model import plan

SIZES = (2, 4)
PPS = 500.0
"""At each switch: four of them leave two processors idle for most of the time; where they are busy, batches grow, and
a packet costs less than at one switch."""
MORE = 4
"""Times as many at one switch, to tell what packets cost from what batches cost."""
SECONDS = 20.0
_DAY_S = 86_400


@dataclass(frozen=True)
class Size:
    """Prediction and measurement for so many switches."""

    switches: int
    pps: float
    """At all of them together, as it was sent."""
    carried: bool
    cores: float
    predicted_cores: float
    unscaled_cores: float
    """Predicted, if the machine were as fast as it was when the costs were measured."""
    gb_per_day: float
    predicted_gb_per_day: float
    by_process: Mapping[str, tuple[float, float]]
    """Cores: measured, predicted."""

    @property
    def errors(self) -> dict[str, float]:
        """Relative, by what was predicted."""
        return {
            "cores": abs(self.predicted_cores - self.cores) / self.cores,
            "gb_per_day": abs(self.predicted_gb_per_day - self.gb_per_day) / self.gb_per_day,
        }

    @property
    def unscaled_error(self) -> float:
        """Relative, of cores."""
        return abs(self.unscaled_cores - self.cores) / self.cores


def figures_of(pps: float = PPS, seconds: float = SECONDS) -> dict[str, Any]:
    """`plan_error`, what it is made of, and the costs.

    Args:
        pps: packets a second at each switch.
        seconds: of load, for each size.

    Raises:
        SdnatorError: a pipeline does not start, or cannot carry that rate.
    """
    train = round(pps * TRAIN_S)
    schedule = Schedule(rates=(pps, MORE * pps), seconds=seconds, more=False)
    with tempfile.TemporaryDirectory(prefix="cluster-plan-") as name:
        before = _one(Path(name) / "before", schedule, train)
        phases = [_phases(Path(name) / str(number), number, pps, seconds) for number in SIZES]
        costs = mean_of(before, _one(Path(name) / "after", schedule, train))
    sizes = [compared(number, *each, costs) for number, each in zip(SIZES, phases, strict=True)]
    unscaled = max(size.unscaled_error for size in sizes)
    error = max(value for size in sizes for value in size.errors.values())
    return {
        "plan_error": round(error, 4),
        "plan_error_unscaled": round(max(error, unscaled), 4),
        "plan_errors": {
            f"{size.switches}_switches": {what: round(value, 4) for what, value in size.errors.items()}
            for size in sizes
        },
        "plan_sizes": [_shown(size) for size in sizes],
        "plan_carried": all(size.carried for size in sizes),
        "plan_costs": to_builtins(costs),
    }


def _one(folder: Path, schedule: Schedule, train: int) -> Costs:
    with MeasuredPipeline(folder, 1, train) as pipeline:
        return one_switch(pipeline, schedule, train, _tell)


def mean_of(one: Costs, other: Costs) -> Costs:
    """Costs of two measurements of the same, each as fast as its machine was.

    Args:
        one: whose other figures are kept.
        other: of the same rates; if it carried more of them, it is taken alone.
    """
    if len(one.rates) != len(other.rates):
        return max(one, other, key=lambda costs: len(costs.rates))
    speed = one.reference_us / other.reference_us if one.reference_us and other.reference_us else 1.0

    def mean(cost: ProcessCost, same: ProcessCost) -> ProcessCost:
        pairs = zip(cost.us_per_packet, same.us_per_packet, strict=True)
        return replace(
            cost,
            idle_cores=(cost.idle_cores + speed * same.idle_cores) / 2,
            us_per_packet=tuple((first + speed * second) / 2 for first, second in pairs),
        )

    names = one.processes.keys() & other.processes.keys()
    found = {name: mean(one.processes[name], other.processes[name]) for name in sorted(names)}
    return replace(one, processes={**one.processes, **found})


def _phases(folder: Path, switches: int, pps: float, seconds: float) -> tuple[LoadPhase, LoadPhase]:
    _tell(f"{switches} switches at {pps:,.0f} packets a second each")
    train = round(switches * pps * TRAIN_S)
    with MeasuredPipeline(folder, switches, train) as pipeline:
        idle = pipeline.idle(seconds)
        pipeline.loaded(pps, TRAIN_S)
        return idle, pipeline.loaded(pps, seconds)


def compared(switches: int, idle: LoadPhase, busy: LoadPhase, costs: Costs) -> Size:
    """Prediction and measurement: while packets came, without what came after them."""
    idle = idle.at(busy.reference_us)
    speed = busy.reference_us / costs.reference_us if busy.reference_us and costs.reference_us else 1.0
    rate = busy.sent / busy.load_s
    made = plan(PipelineDemand(switches=switches, pps=rate), costs)
    used = {
        name: idle.cpu_s.get(name, 0.0) / idle.elapsed_s + over_idle(busy, idle, name) / busy.load_s
        for name in sorted(busy.cpu_s)
    }
    rest = idle.archived / idle.elapsed_s
    archived = rest + (busy.archived - rest * busy.elapsed_s) / busy.load_s
    predicted = {row.name: speed * row.cores for row in made.rows}
    return Size(
        switches=switches,
        pps=rate,
        carried=busy.carried,
        cores=sum(used.values()),
        predicted_cores=speed * made.cores,
        unscaled_cores=made.cores,
        gb_per_day=archived * _DAY_S / 1e9,
        predicted_gb_per_day=made.archive_gb_per_day,
        by_process={name: (cores, predicted.get(name, 0.0)) for name, cores in used.items()},
    )


def _shown(size: Size) -> dict[str, Any]:
    return {
        "switches": size.switches,
        "pps": round(size.pps, 1),
        "carried": size.carried,
        "cores": round(size.cores, 4),
        "predicted_cores": round(size.predicted_cores, 4),
        "predicted_cores_unscaled": round(size.unscaled_cores, 4),
        "gb_per_day": round(size.gb_per_day, 3),
        "predicted_gb_per_day": round(size.predicted_gb_per_day, 3),
        "cores_by_process": {
            name: {"measured": round(one, 4), "predicted": round(other, 4)}
            for name, (one, other) in size.by_process.items()
        },
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, write; 1 where a rate was not carried, so that the error says nothing."""
    options = _options(argv)
    if os.geteuid() != 0:
        raise SystemExit("cluster_plan: needs root, for the interfaces of the switches")
    about = machine()
    try:
        figures = figures_of(options.pps, options.seconds)
        if options.costs is not None:
            # with all rates, queries and consumers, too
            write(options.costs, replace(measured(Schedule(), _tell), error=figures["plan_error_unscaled"]))
    except SdnatorError as error:
        raise SystemExit(f"cluster_plan: {error}") from None
    rows = [
        [
            each["switches"],
            each["pps"],
            each["cores"],
            each["predicted_cores"],
            each["gb_per_day"],
            each["predicted_gb_per_day"],
        ]
        for each in figures["plan_sizes"]
    ]
    table(["switches", "packets/s", "cores", "predicted", "GB/day", "predicted"], rows)
    print(f"plan_error {figures['plan_error']:.1%}, unscaled {figures['plan_error_unscaled']:.1%}")
    print(f"all packets carried: {figures['plan_carried']}")
    write_json(options.json, {"machine": about, **figures})
    return int(not figures["plan_carried"])


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="benchmarks.cluster_plan",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--costs", type=Path, help="where to write the costs of this machine")
    parser.add_argument("--pps", type=float, default=PPS, help="packets a second at each switch")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of load, for each size")
    return parser.parse_args(argv)


def _tell(text: str) -> None:
    print(f"cluster_plan: {text}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
