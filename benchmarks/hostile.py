"""Mutated inputs for every decoder that faces bytes from outside: `python -m benchmarks.hostile --json FILE`.

    [--inputs N] [--seconds S] [--seed S] [--only TARGET …] [--hang S] [--workers N] [--no-guided]

Each target attacks one decoder in child processes of its own (`hostile_child`), forked from processes that have
imported the product once (`hostile_worker`).  Whatever is raised beside the declared errors, a death of the process,
a report of a sanitizer, or more than 4 GB is a crash; one input that takes more than `--hang` CPU seconds is a hang.
The same seed makes the same inputs, except those that are guided by coverage (with atheris, extra `fuzz`); every
finding has its input.  Exit code 1 where there are crashes, hangs, or targets whose memory grows.
"""

import argparse
import importlib.util
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.hostile_job import Figures
from benchmarks.hostile_pool import GUIDED, PLAIN, SANITIZED, Attack, Campaign, Pool, ProcessKind, rate
from benchmarks.hostile_sanitizers import builds, environment, is_sanitized
from benchmarks.hostile_worker import targets_of
from benchmarks.measure import machine, table, write_json

MODULES = (
    # first, for the others run while its builds are made
    "benchmarks.hostile_native",
    "benchmarks.hostile_checkpoints",
    "benchmarks.hostile_due",
    "benchmarks.hostile_messages",
    "benchmarks.hostile_queries",
    "benchmarks.hostile_http",
    "benchmarks.hostile_files",
    "benchmarks.hostile_archives",
    "benchmarks.hostile_switch",
    "benchmarks.hostile_control",
)
"""Each lists its TARGETS; those with `SANITIZED = True` run with the sanitizers' libraries."""
INPUTS = 1_000_000
SECONDS = 600.0
_MOST_GROWTH_MB = 32.0
"""Between the first quarter of a run and its end; more counts as memory that is not flat."""
_MOST_SHOWN = 200


def main(argv: Sequence[str] | None = None) -> int:
    """Attack, print, write; 1 where something was found."""
    options = _options(argv)
    found = attack_all(
        chosen(options.only),
        inputs=options.inputs,
        seconds=options.seconds,
        workers=options.workers,
        attack=Attack(options.seed, options.hang),
        guided=options.guided,
    )
    _show(found)
    write_json(options.json, {**found, "machine": machine()})
    return int(bool(found["crashes"] or found["hangs"] or found["grown"]))


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="benchmarks.hostile", description=__doc__)
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--inputs", type=int, default=INPUTS, help="of all targets together")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="the longest that all of it may take")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="TARGET", help="targets that begin with this"
    )
    parser.add_argument(
        "--hang", type=float, default=5.0, metavar="S", help="one input that takes more CPU time hangs"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="child processes at a time")
    parser.add_argument(
        "--no-guided", dest="guided", action="store_false", help="nothing by coverage, also where atheris is"
    )
    return parser.parse_args(argv)


def chosen(only: Sequence[str] = (), modules: Sequence[str] = MODULES) -> dict[str, list[str]]:
    """Names of targets by module; raises SystemExit for one that there is not."""
    found = {module: [target.name for target in targets_of(module)] for module in modules}
    if not only:
        return found
    kept = {
        module: [name for name in names if any(name.startswith(word) for word in only)]
        for module, names in found.items()
    }
    if not any(kept.values()):
        every = ", ".join(name for names in found.values() for name in names)
        raise SystemExit(f"no target begins with {' or '.join(only)}; there are {every}")
    return {module: names for module, names in kept.items() if names}


def attack_all(
    targets: Mapping[str, Sequence[str]],
    *,
    inputs: int,
    seconds: float,
    workers: int,
    attack: Attack,
    guided: bool = False,
) -> dict[str, Any]:
    """The figures of the JSON, without the machine."""
    began = time.monotonic()
    kinds = {
        name: SANITIZED if is_sanitized(module) else PLAIN
        for module, names in targets.items()
        for name in names
    }
    modules = {
        kind: [each for each in targets if is_sanitized(each) == (kind == SANITIZED)]
        for kind in (PLAIN, SANITIZED)
    }
    guided = guided and _has_atheris()
    by_coverage = [name for name, kind in kinds.items() if kind == PLAIN and guided]
    with ThreadPoolExecutor(1) as builder:
        # at once, beside the other targets: it takes longer than most of them
        built = builder.submit(builds) if modules[SANITIZED] else None
        makers: dict[str, Callable[[], ProcessKind]] = {
            PLAIN: partial(ProcessKind, modules[PLAIN]),
            GUIDED: partial(ProcessKind, modules[PLAIN], guided=True),
        }
        if built is not None:
            makers[SANITIZED] = lambda: ProcessKind(modules[SANITIZED], environment(built.result()[0]))
        pool = Pool(kinds, makers, workers)
        try:
            campaign = Campaign(
                pool, list(kinds), attack, guided=by_coverage, inputs=inputs, seconds=seconds, workers=workers
            )
            campaign.run()
        finally:
            pool.close()
        build_s = built.result()[1] if built else 0.0
    return _figures(campaign.results, attack.seed, time.monotonic() - began, build_s)


def _has_atheris() -> bool:
    if importlib.util.find_spec("atheris") is not None:
        return True
    print("atheris is not installed (extra `fuzz`): no inputs are guided by coverage", file=sys.stderr)
    return False


def _figures(results: Mapping[str, Figures], seed: int, seconds: float, build_s: float) -> dict[str, Any]:
    targets = {
        name: {
            "inputs": one.inputs,
            "guided": one.guided,
            "crashes": one.crashes,
            "hangs": one.hangs,
            "rss_first_mb": round(one.rss_first_mb, 1),
            "rss_last_mb": round(one.rss_last_mb, 1),
            "peak_mb": round(one.peak_mb, 1),
            "inputs_per_s": round(rate(one), 1),
            "cpu_s": round(one.cpu_s, 2),
        }
        for name, one in results.items()
    }
    totals = {
        what: sum(one[what] for one in targets.values()) for what in ("inputs", "guided", "crashes", "hangs")
    }
    cpu_s = sum(one.cpu_s for one in results.values())
    grown = [name for name, one in results.items() if one.rss_last_mb - one.rss_first_mb > _MOST_GROWTH_MB]
    return {
        **totals,
        "grown": grown,
        "targets": targets,
        "seed": seed,
        "seconds": round(seconds, 1),
        "cpu_s": round(cpu_s, 2),
        "inputs_per_cpu_s": round(totals["inputs"] / max(cpu_s, 1e-6), 1),
        "sanitizer_builds_s": round(build_s, 1),
        "findings": [finding for one in results.values() for finding in _distinct(one.findings)],
    }


def _distinct(findings: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One for each error and place."""
    kept: dict[tuple[str, str], dict[str, Any]] = {}
    for one in findings:
        kept.setdefault((one["error"].partition(":")[0], one["where"]), one)
    return list(kept.values())


def _show(found: Mapping[str, Any]) -> None:
    rows = [[name, *one.values()] for name, one in found["targets"].items()]
    table(
        [
            "target",
            "inputs",
            "guided",
            "crashes",
            "hangs",
            "first MB",
            "last MB",
            "peak MB",
            "inputs/s",
            "CPU s",
        ],
        rows,
    )
    for one in found["findings"]:
        print(
            f"\n{one['target']} input {one['index']}: {one['kind']}: {one['error']}\n  {one['input'][:_MOST_SHOWN]}"
        )
        print(one["traceback"])
    print(
        f"\n{found['inputs']:,} inputs ({found['guided']:,} guided), {found['crashes']} crashes, {found['hangs']} hangs, "
        f"{len(found['grown'])} grow; {found['seconds']} s, {found['cpu_s']} CPU s "
        f"({found['inputs_per_cpu_s']:,.0f} inputs a CPU second), builds {found['sanitizer_builds_s']} s"
    )


if __name__ == "__main__":
    sys.exit(main())
