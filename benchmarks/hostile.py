"""Mutated inputs for every decoder that faces bytes from outside: `python -m benchmarks.hostile --json FILE`.

    [--inputs N] [--seconds S] [--seed S] [--only TARGET …] [--hang S] [--workers N]

Each target attacks one decoder in a child process of its own.  Whatever is raised beside the declared errors, a
death of the process, a report of a sanitizer, or more than 4 GB is a crash; one input that takes longer than
`--hang` is a hang.  The same seed makes the same inputs.  Exit code 1 where there are crashes or hangs.
"""

import argparse
import math
import os
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.hostile_child import Attack, Figures, Job, run_jobs
from benchmarks.hostile_sanitizers import environment_for
from benchmarks.hostile_worker import targets_of
from benchmarks.measure import machine, table, write_json

MODULES = (
    # first, for the others run while its builds are made
    "benchmarks.hostile_native",
    "benchmarks.hostile_due",
    "benchmarks.hostile_messages",
    "benchmarks.hostile_queries",
    "benchmarks.hostile_files",
    "benchmarks.hostile_switch",
    "benchmarks.hostile_control",
)
"""Each lists its TARGETS; those with `SANITIZED = True` run with the sanitizers' libraries."""
INPUTS = 1_000_000
SECONDS = 600.0
_TRIAL = 120
"""Inputs of a target that tell its rate."""
_TRIAL_SHARE = 0.2
"""Of the time, for all trials together."""
_SHARE_OF_TIME = 0.85
_LEAST = 200
_MOST_SHARE = 0.05
"""Of all inputs, for one target: a cheap one must not stand for the others."""
_MOST_SHOWN = 200
_ROUNDS = 4


def main(argv: Sequence[str] | None = None) -> int:
    """Attack, print, write; 1 where something was found."""
    options = _options(argv)
    found = attack_all(
        chosen(options.only),
        inputs=options.inputs,
        seconds=options.seconds,
        workers=options.workers,
        attack=Attack(options.seed, options.hang),
    )
    _show(found)
    write_json(options.json, {**found, "machine": machine()})
    return int(bool(found["crashes"] or found["hangs"]))


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
        "--hang", type=float, default=5.0, metavar="S", help="one input that takes longer hangs"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="child processes at a time")
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
    targets: Mapping[str, Sequence[str]], *, inputs: int, seconds: float, workers: int, attack: Attack
) -> dict[str, Any]:
    """The figures of the JSON, without the machine."""
    began = time.monotonic()
    results = {name: Figures() for names in targets.values() for name in names}
    modules = {name: module for module, names in targets.items() for name in names}
    trial = min(_TRIAL, max(1, inputs // max(1, len(results))))
    longest = seconds * max(1, workers) * _TRIAL_SHARE / max(1, len(results))
    with ThreadPoolExecutor(max(1, workers)) as pool:
        plan = [
            (module, [Job(name, 0, trial, longest) for name in names]) for module, names in targets.items()
        ]
        for _ in range(_ROUNDS + 1):
            left = seconds - (time.monotonic() - began)
            if left <= 0 or not plan:
                break
            made = [(module, jobs, attack, left) for module, jobs in plan]
            for (_, jobs), figures in zip(plan, pool.map(_run, made), strict=True):
                for job, one in zip(jobs, figures, strict=True):
                    _add(results[job.target], one)
            left = seconds - (time.monotonic() - began)
            counts = shares(results, inputs, left * max(1, workers) * _SHARE_OF_TIME)
            # the longest first, so that no worker is left alone with it
            slow = sorted(counts, key=lambda name: counts[name] / _rate(results[name]), reverse=True)
            plan = [(modules[name], [Job(name, results[name].inputs, counts[name])]) for name in slow]
    return _figures(results, attack.seed, time.monotonic() - began)


def _run(work: tuple[str, Sequence[Job], Attack, float]) -> list[Figures]:
    module, jobs, attack, seconds = work
    print(f"{', '.join(f'{job.target} {job.count:,}' for job in jobs)[:150]}", file=sys.stderr, flush=True)
    return run_jobs(module, jobs, Attack(attack.seed, attack.hang_s, environment_for(module)), seconds)


def _rate(figures: Figures) -> float:
    return max(0.1, figures.inputs / max(figures.seconds, 1e-6))


def shares(results: Mapping[str, Figures], inputs: int, seconds: float) -> dict[str, int]:
    """How many inputs each target gets of those that are left: fast ones more, as much as the time asks for.

    Args:
        results: with inputs and seconds so far.
        inputs: of all targets together, those included that were made already.
        seconds: of one process, that are left.
    """
    missing = inputs - sum(one.inputs for one in results.values())
    if missing <= 0 or seconds <= 0:
        return {}
    rates = {name: _rate(one) for name, one in results.items() if one.inputs}
    counts: dict[str, int] = {}
    for power in range(5, 21):
        weights = {name: rate ** (power / 10) for name, rate in rates.items()}
        whole = math.fsum(weights.values())
        most = max(_LEAST, round(inputs * _MOST_SHARE), round(missing / len(rates)))
        counts = {
            name: min(most, max(_LEAST, round(missing * weight / whole))) for name, weight in weights.items()
        }
        if sum(count / rates[name] for name, count in counts.items()) <= seconds:
            break
    return counts


def _add(whole: Figures, part: Figures) -> None:
    whole.inputs += part.inputs
    whole.crashes += part.crashes
    whole.hangs += part.hangs
    whole.seconds += part.seconds
    # of the longest run: a short one shows what is made once
    whole.rss_growth_mb = part.rss_growth_mb
    whole.findings += part.findings


def _figures(results: Mapping[str, Figures], seed: int, seconds: float) -> dict[str, Any]:
    targets = {
        name: {
            "inputs": one.inputs,
            "crashes": one.crashes,
            "hangs": one.hangs,
            "rss_growth_mb": round(one.rss_growth_mb, 2),
            "inputs_per_s": round(_rate(one), 1),
        }
        for name, one in results.items()
    }
    totals = {what: sum(one[what] for one in targets.values()) for what in ("inputs", "crashes", "hangs")}
    findings = [finding for one in results.values() for finding in _distinct(one.findings)]
    return {**totals, "targets": targets, "seed": seed, "seconds": round(seconds, 1), "findings": findings}


def _distinct(findings: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One for each error and place."""
    kept: dict[tuple[str, str], dict[str, Any]] = {}
    for one in findings:
        kept.setdefault((one["error"].partition(":")[0], one["where"]), one)
    return list(kept.values())


def _show(found: Mapping[str, Any]) -> None:
    rows = [[name, *one.values()] for name, one in found["targets"].items()]
    table(["target", "inputs", "crashes", "hangs", "RSS growth MB", "inputs/s"], rows)
    for one in found["findings"]:
        print(
            f"\n{one['target']} input {one['index']}: {one['kind']}: {one['error']}\n  {one['input'][:_MOST_SHOWN]}"
        )
        print(one["traceback"])
    print(
        f"\n{found['inputs']:,} inputs, {found['crashes']} crashes, {found['hangs']} hangs, {found['seconds']} s"
    )


if __name__ == "__main__":
    sys.exit(main())
