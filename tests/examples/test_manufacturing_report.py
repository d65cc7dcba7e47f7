"""The comparison: results that are kept and gone on with, the report's figures, and the command."""

import json
import re

import msgspec
import pytest
from manufacturing.core.orders import Scenario
from manufacturing.criteria import FLEETS
from manufacturing.running import report
from manufacturing.running import verify as module
from manufacturing.running.command import main
from manufacturing.running.in_process import InProcessProduction
from manufacturing.running.verify import verify
from manufacturing.statistics import CellResult, CellTable, cells

SHARE = {
    "decentralized": 1.0,
    "baseline": 0.9,
    "fcfs": 0.8,
    "urgent_first": 0.8,
    "dynamic": 0.5,
    "bound": 0.48,
}


@pytest.fixture
def results(tmp_path):
    """A file with all cells of two seeds, made up."""
    path = tmp_path / "cells.jsonl"
    rows = [
        CellResult(
            scenario=kind,
            scheduler=name,
            machines=n,
            seed=seed,
            makespan=SHARE[name] * (100 + seed),
            ppe_makespan=(0.1 if name in ("dynamic", "urgent_first") else 1.0) * (50 + seed),
            faults=2,
            alarms=2,
            prints=9,
        )
        for kind, name, n, seed in cells(2)
    ]
    path.write_bytes(b"\n".join(msgspec.json.encode(row) for row in rows) + b"\n")
    return path


def test_what_is_in_the_file_is_not_simulated_again(results, tmp_path, capsys):
    """`compare` on a whole file writes four pictures and a report, and judges by the criteria."""
    folder = tmp_path / "report"
    assert main(["compare", "--seeds", "2", "--results", str(results), "--report", str(folder)]) == 0
    assert "2 of 2 seeds are complete" in capsys.readouterr().out
    assert {path.name for path in folder.glob("*.png")} == {f"{name}.png" for name, *_ in report.FIGURES}
    figures = json.loads((folder / "report.json").read_text())
    assert all(one["held"] for one in figures["criteria"])
    beside = figures["beside"][0]
    assert not beside["held"]  # a first come, first served that knows priority is as quick
    assert beside["figures"]["20"]["mean"] == pytest.approx(1.0)
    assert figures["shares"]["normal"]["dynamic"]["5"]["mean"] == pytest.approx(0.5)
    assert (
        "| 12 | PPE: urgent makespan, dynamic / urgent_first | 0.67 |" in (folder / "report.md").read_text()
    )


def test_a_run_that_was_cut_short_counts_its_whole_seeds(results):
    """A seed of which a cell is missing is not counted."""
    lines = results.read_bytes().splitlines()
    results.write_bytes(b"\n".join(lines[:-1]) + b"\n")
    assert CellTable(results).whole_seeds(FLEETS) == 1


@pytest.mark.parametrize(
    ("words", "says"),
    [(["--machines", "0"], "machines=0 (1 to 1000)"), (["--fraction", "2"], "fraction=2.0")],
)
def test_wrong_options_are_refused_with_the_bounds(words, says, capsys):
    """Exit code 2 and one line."""
    assert main(["run", "--in-process", *words]) == 2
    assert says in capsys.readouterr().err


def test_run_ends_with_the_schedule_of_the_simulation(capsys):
    """The command in one process: address of the page, makespan, and the comparison with the pure cores."""
    words = [
        "run",
        "--in-process",
        "--scheduler",
        "fcfs",
        "--machines",
        "2",
        "--orders",
        "3",
        "--fraction",
        "0.05",
    ]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "live Gantt chart: http://127.0.0.1:" in said
    assert "schedule through REST and DUE as in the simulation: yes" in said


def test_verify_names_the_first_print_that_differs():
    """Held against the simulation of another scheduler than the one that ran."""

    class Other(InProcessProduction):
        def __init__(self, scenario, _name):
            super().__init__(scenario, "fcfs")

    cell = verify(Scenario(name="normal", seed=4, machines=2, orders=3, fraction=0.05), "baseline", Other)
    assert not cell.same
    assert re.fullmatch(
        r"another schedule: on m0\d simulated job \S+ from \d+ s, found job \S+ from \d+ s", cell.problem
    )


def test_verify_goes_on_where_it_stopped(tmp_path, capsys, monkeypatch):
    """Each cell once through REST and DUE; what the file holds is not run again.

    That all scenarios and schedulers go through is shown by test_rest_and_due_change_no_schedule.
    """
    kinds, names = ("normal", "anomalies"), ("fcfs", "dynamic")
    monkeypatch.setattr(module, "SCENARIOS", kinds)
    monkeypatch.setattr(module, "SCHEDULERS", names)
    path = tmp_path / "verified.jsonl"
    small = ["--fleets", "2", "--orders", "2", "--fraction", "0.02", "--in-process"]
    words = ["verify", "--results", str(path), "--seed", "3", *small]
    assert main(words) == 0
    said = capsys.readouterr().out
    cells_of_a_fleet = len(kinds) * len(names)
    assert (
        f"{cells_of_a_fleet} of {cells_of_a_fleet} schedules as in the simulation; 0 cells are missing"
        in said
    )
    assert "anomalies, dynamic, 2 printers: the same schedule" in said
    lines = path.read_text().splitlines()
    changed = json.loads(lines.pop()) | {"same": False}
    path.write_text("\n".join([*lines[1:], json.dumps(changed)]) + "\n")
    assert main(words) == 1
    said = capsys.readouterr().out
    assert said.count("the same schedule") == 1
    assert f"{cells_of_a_fleet - 1} of {cells_of_a_fleet} schedules" in said
