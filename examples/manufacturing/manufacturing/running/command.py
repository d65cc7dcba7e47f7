"""The command `sdnator-manufacturing`: `run` one scenario live, `verify` that REST and DUE change no schedule, `compare`
all schedulers over seeds and fleets."""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final, get_args

import msgspec

from manufacturing.core.orders import ORDERS, Scenario, ScenarioName
from manufacturing.core.simulation import simulate
from manufacturing.criteria import FLEETS, NORMAL_FLEET, SEEDS
from manufacturing.running import report
from manufacturing.running.in_process import InProcessProduction
from manufacturing.running.page import GanttPage
from manufacturing.running.processes import ProcessProduction
from manufacturing.running.verify import MOST_S, STEP_S, VerifiedCell, verify_all
from manufacturing.running.watcher import Stalled
from manufacturing.scheduling import SchedulerName, scheduler
from manufacturing.statistics import CellTable, measure

_NOT_WHOLE: Final = 3


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code: 0, 1 the run did not end well, 2 wrong options, 3 not all measured."""
    options = _parser().parse_args(argv)
    try:
        return int(options.do(options))
    except (ValueError, Stalled) as error:
        print(f"sdnator-manufacturing: {error}", file=sys.stderr)
        return 2 if isinstance(error, ValueError) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="sdnator-manufacturing", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    run = commands.add_parser(
        "run", help="one scenario through REST, DUE and Coordinator, with a live Gantt chart"
    )
    run.add_argument("--scenario", choices=get_args(ScenarioName), default="normal")
    run.add_argument("--scheduler", choices=get_args(SchedulerName), default="dynamic")
    run.add_argument("--machines", type=int, default=5, help="printers, 1 to 1000")
    run.add_argument(
        "--seeds", type=int, default=1, help="the first one live, the others from the pure cores"
    )
    _add_size(run)
    run.add_argument(
        "--speed-up", type=float, default=0.0, help="simulated seconds a second at most; 0: no limit"
    )
    run.add_argument("--port", type=int, default=0, help="of the page; 0 takes a free one")
    run.add_argument(
        "--stay", type=float, default=0.0, help="seconds for which the page stays when all is done"
    )
    run.set_defaults(do=_run)
    check = commands.add_parser(
        "verify", help="one seed of each cell through REST, DUE and Coordinator: the simulation's schedule?"
    )
    _add_size(check)
    check.add_argument("--seed", type=int, default=0)
    check.add_argument("--fleets", type=_fleets, default=FLEETS, help="sizes, such as 5,10,20,40")
    check.add_argument("--results", type=Path, required=True, help="file of JSON lines; what it has is kept")
    check.add_argument(
        "--minutes", type=float, default=0.0, help="begin no more cells after so long; 0: no limit"
    )
    check.set_defaults(do=_verify)
    compare = commands.add_parser("compare", help="all scenarios, schedulers and fleets from the pure cores")
    compare.add_argument("--seeds", type=int, default=SEEDS)
    compare.add_argument("--fleets", type=_judged_fleets, default=FLEETS, help="sizes, such as 5,10,20,40")
    compare.add_argument(
        "--results", type=Path, required=True, help="file of JSON lines; what it has is kept"
    )
    compare.add_argument("--report", type=Path, help="folder for figures and report.md")
    compare.add_argument("--workers", type=int, default=1)
    compare.add_argument(
        "--minutes", type=float, default=0.0, help="begin no more cells after so long; 0: no limit"
    )
    compare.set_defaults(do=_compare)
    return parser


def _add_size(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--orders", type=int, default=ORDERS, help="fewer for a quick look")
    parser.add_argument(
        "--fraction", type=float, default=1.0, help="of the jobs of each order, for a quick look"
    )
    parser.add_argument("--in-process", action="store_true", help="all apps in one process over memory://")


def _fleets(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split(","))


def _judged_fleets(text: str) -> tuple[int, ...]:
    found = _fleets(text)
    if NORMAL_FLEET not in found:
        raise argparse.ArgumentTypeError(f"{text}: the criteria need a fleet of {NORMAL_FLEET}")
    return found


def _run(options: argparse.Namespace) -> int:
    scenario = Scenario(
        name=options.scenario,
        seed=0,
        machines=options.machines,
        orders=options.orders,
        fraction=options.fraction,
    )
    kind = InProcessProduction if options.in_process else ProcessProduction
    print(f"{scenario.name}, {scenario.machines} printers, {options.scheduler}", flush=True)
    with (
        kind(scenario, options.scheduler, speed_up=options.speed_up) as production,
        GanttPage(production.watcher.state, port=options.port) as page,
    ):
        print(f"live Gantt chart: {page.url}", flush=True)
        begun = time.monotonic()
        production.watcher.wait_done(STEP_S, MOST_S)
        print(f"all jobs done after {time.monotonic() - begun:.1f} s", flush=True)
        prints = production.watcher.prints()
        time.sleep(options.stay)
    expected = simulate(scenario, scheduler(options.scheduler))
    same = prints == expected.prints
    print(f"makespan {expected.makespan / 3_600:.2f} h, {sum(map(len, prints.values()))} prints")
    print(f"schedule through REST and DUE as in the simulation: {'yes' if same else 'no'}")
    for seed in range(1, options.seeds):
        result = measure(scenario.name, options.scheduler, scenario.machines, seed)
        print(
            f"seed {seed}: makespan {result.makespan / 3_600:.2f} h, urgent {result.ppe_makespan / 3_600:.2f} h"
        )
    return 0 if same else 1


def _verify(options: argparse.Namespace) -> int:
    def scenario(name: ScenarioName, machines: int) -> Scenario:
        return Scenario(
            name=name,
            seed=options.seed,
            machines=machines,
            orders=options.orders,
            fraction=options.fraction,
        )

    found, missing = verify_all(
        scenario,
        options.fleets,
        options.results,
        production=InProcessProduction if options.in_process else ProcessProduction,
        minutes=options.minutes,
        tell=_tell_cell,
    )
    same = sum(one.same for one in found)
    print(f"{same} of {len(found)} schedules as in the simulation; {missing} cells are missing")
    if same < len(found):
        return 1
    return _NOT_WHOLE if missing else 0


def _tell_cell(one: VerifiedCell) -> None:
    result = one.problem or ("the same schedule" if one.same else "another schedule")
    print(
        f"{one.scenario}, {one.scheduler}, {one.machines} printers: {result}, "
        f"{one.prints} prints, {one.seconds:.1f} s",
        flush=True,
    )


def _compare(options: argparse.Namespace) -> int:
    table = CellTable(options.results)
    table.fill(options.seeds, options.fleets, workers=options.workers, minutes=options.minutes)
    whole = min(table.whole_seeds(options.fleets), options.seeds)
    print(f"{whole} of {options.seeds} seeds are complete")
    if whole and options.report is not None:
        figures = report.figures_of(table, whole, options.fleets)
        (path := report.write(figures, options.report)).with_suffix(".json").write_bytes(
            msgspec.json.encode(figures)
        )
        print(path)
    return 0 if whole == options.seeds else _NOT_WHOLE


if __name__ == "__main__":
    sys.exit(main())
