"""The whole pipeline under load and faults: `python -m benchmarks.chaos --json FILE --seconds N --seed S`.

    schedule (seed) ──► faults ──► pipeline of `sdnator up` ◄── load and probes ──► record ──► checker

A seeded scheduler draws fault and moment (`chaos_schedule`), `chaos_faults` carries them out on the parts of
`chaos_stage`, `chaos_probes` and `chaos_frames` note what was promised and what came, and `chaos_checker`
holds one against the other.  Exit code 1 where a promise was broken.
"""

import argparse
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.chaos_checker import Violation, check
from benchmarks.chaos_faults import ACTIONS, NOT_DONE, FaultAction, left_out
from benchmarks.chaos_frames import LATE_S, ForwardingProbe
from benchmarks.chaos_probes import Probes, until
from benchmarks.chaos_schedule import KINDS, PAIR, PlannedFault, schedule
from benchmarks.chaos_stage import ChaosStage
from benchmarks.faults_stage import ChildProgram
from benchmarks.measure import machine, table, write_json

_LOOK_S = 0.05
_SETTLE_S = 90.0
_WARM_S = 10.0
_AGAIN_S = 1.0
_REACHES_SWITCH = ("switch", "p4runtime_ctrl", "firewall", "updates", "coordinator", "disk")


class ChaosRun:
    """One run; `go` returns its figures."""

    def __init__(
        self, seed: int, seconds: float, kinds: Sequence[str], folder: Path, keep: Path | None = None
    ) -> None:
        self._seed, self._seconds = seed, seconds
        self._faults = schedule(seed, seconds, kinds)
        self._folder = folder
        self._keep = keep
        self._stack = ExitStack()
        self._pair: dict[str, ChildProgram] = {}
        self._pair_dead: dict[str, float] = {}
        self._spoken = 0
        self._begun: list[tuple[float, PlannedFault]] = []
        self._settled_s = float("nan")

    def go(self) -> dict[str, Any]:
        """Start, break, settle, judge."""
        with self._stack:
            self._stage = self._stack.enter_context(ChaosStage(self._folder))
            updates = self._stage.parts.updates
            self._probes = Probes(self._folder, updates, self._stage.archive, self._seed)
            self._stack.callback(self._probes.close)
            self._stack.callback(self._end_pair)
            for name in PAIR:
                self._speak(name)
            self._probes.start()
            self._wire = self._forwarding()
            self._look_for(_WARM_S)
            self._break()
            self._settle()
            if self._keep is not None:
                shutil.copytree(self._stage.disk, self._keep, ignore=_no_sockets, dirs_exist_ok=True)
            return self._figures()

    def _forwarding(self) -> ForwardingProbe | None:
        if self._stage.wires is None:
            return None
        entry, leave = self._stage.wires
        probe = ForwardingProbe(entry.near, leave.far, self._probes.blocked)
        probe.start()
        return probe

    def _look(self) -> None:
        """What `sdnator up` does in its loop, and the same for the standby pair."""
        self._stage.supervisor.watch()
        now = time.monotonic()
        for name, program in self._pair.items():
            if program.process.poll() is None:
                continue
            if now - self._pair_dead.setdefault(name, now) > _AGAIN_S:
                self._speak(name)
        self._stage.supervisor.wait(_LOOK_S)

    def _look_for(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self._look()

    def _speak(self, name: str) -> None:
        self._spoken += 1
        output = self._folder / f"{name}-{self._spoken}.jsonl"
        self._pair[name] = ChildProgram(output, "speak", self._stage.parts.updates, 0.1)
        self._pair_dead.pop(name, None)

    def _end_pair(self) -> None:
        for program in self._pair.values():
            program.kill()

    def _pid(self, name: str) -> int:
        return self._pair[name].process.pid if name in self._pair else self._stage.supervisor.pids()[name]

    def _break(self) -> None:
        began = time.monotonic()
        lasting: list[tuple[float, FaultAction]] = []
        for fault in [*self._faults, None]:
            due = began + (fault.at if fault is not None else self._seconds)
            while (now := time.monotonic()) < due:
                for ends, action in [each for each in lasting if each[0] <= now]:
                    action.end()
                    lasting.remove((ends, action))
                self._look()
            if fault is not None:
                print(
                    f"{fault.at:7.1f} s  {fault.kind:12} {'+'.join(fault.targets)}",
                    file=sys.stderr,
                    flush=True,
                )
                action = ACTIONS[fault.kind](fault, self._stage, self._pid)
                self._begun.append((now, fault))
                action.begin()
                lasting.append((now + fault.seconds, action))
        for _, action in lasting:
            action.end()

    def _settle(self) -> None:
        """Faults have ended: the load ends, and what was promised may arrive."""
        began = time.monotonic()
        finishing = threading.Thread(target=self._probes.finish, daemon=True)
        finishing.start()
        while finishing.is_alive():
            self._look()

        def look() -> None:
            self._look_for(1.0)
            self._probes.read_entries(self._stage.switch_address)

        done = until(lambda: not self._stage.away() and self._probes.settled(), _SETTLE_S, look)
        self._probes.read_decisions()
        self._settled_s = time.monotonic() - began if done else float("nan")
        if self._wire is not None:
            self._wire.close()

    def _figures(self) -> dict[str, Any]:
        record = self._probes.record
        record.away = self._stage.away()
        record.switch_faults = [
            at + fault.seconds
            for at, fault in self._begun
            if any(name in _REACHES_SWITCH for name in fault.targets)
        ]
        gaps = self._gaps()
        if self._wire is not None:
            record.passed = self._wire.passed
        found = check(record)
        return {
            "faults": {"count": len(self._begun), "list": [self._told(*each, gaps) for each in self._begun]},
            "violations": {"count": len(found), "list": [_as_map(each) for each in found]},
            "forwarding_gap_ms": self._gap_by_target(gaps),
            "forwarding_lost_ms": self._gap_by_target(self._gaps(float("inf"))),
            "seed": self._seed,
            "seconds": self._seconds,
            "settled_s": self._settled_s,
            "operations": self._operations(),
            "restarts": {each.name: each.restarts for each in self._stage.supervisor.reports()},
            "supervisor": self._stage.told,
            "probe_errors": self._probes.errors,
            "left_out": {**NOT_DONE, **left_out()},
            "machine": machine(),
        }

    def _operations(self) -> dict[str, int]:
        record = self._probes.record
        return {
            "acknowledged": record.acknowledged,
            "delivered": len(record.delivered),
            "archived": len(record.archived),
            "instructions": len(record.asked),
            "instructions_unwanted": self._probes.unwanted_instructions,
            "numbers_unwanted": len(record.unwanted),
            "answers": len(record.answers),
            "answers_refused": sum(not done for done in record.answers.values()),
            "decisions": len(record.decisions),
            "entries": len(record.entries or ()),
            "words": len(record.words),
            "scores": self._probes.scores,
            "frames_sent": len(self._wire.sent) if self._wire else 0,
            "frames_forwarded": len(self._wire.came) if self._wire else 0,
            "frames_of_blocked_sources_passed": len(self._wire.passed) if self._wire else 0,
        }

    def _gaps(self, late_s: float = LATE_S) -> dict[int, float]:
        """Longest gap in ms by fault: a gap is that of the last fault that had begun, -1 for none."""
        longest: dict[int, float] = {}
        for at, length in self._wire.gaps(late_s) if self._wire is not None else []:
            index = max((n for n, (begun, _) in enumerate(self._begun) if begun <= at + 0.05), default=-1)
            longest[index] = max(longest.get(index, 0.0), length)
        return longest

    def _gap_by_target(self, gaps: dict[int, float]) -> dict[str, float]:
        found = {"none": gaps.get(-1, 0.0)}
        for index, (_, fault) in enumerate(self._begun):
            name = "+".join(sorted(fault.targets))
            found[name] = max(found.get(name, 0.0), gaps.get(index, 0.0))
        return found if self._wire is not None else {}

    def _told(self, at: float, fault: PlannedFault, gaps: dict[int, float]) -> dict[str, Any]:
        index = next(n for n, (begun, each) in enumerate(self._begun) if (begun, each) == (at, fault))
        return {
            "time": fault.at,
            "kind": fault.kind,
            "target": "+".join(fault.targets),
            "seconds": fault.seconds,
            "forwarding_gap_ms": gaps.get(index, 0.0),
        }


def _no_sockets(folder: str, names: list[str]) -> set[str]:
    return {each for each in names if (Path(folder) / each).is_socket()}


def _as_map(violation: Violation) -> dict[str, str]:
    return {"kind": violation.kind, "detail": violation.detail}


def main(argv: Sequence[str] | None = None) -> int:
    """Run, print, write; 1 where a promise was broken."""
    parser = argparse.ArgumentParser(prog="benchmarks.chaos", description=__doc__)
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--seconds", type=float, default=1800.0, help="length of the load")
    parser.add_argument("--seed", type=int, default=1, help="of the draw of faults")
    parser.add_argument("--only", nargs="+", choices=list(KINDS), metavar="KIND", help="these kinds of fault")
    parser.add_argument("--keep", type=Path, help="folder that takes logs and archive after the run")
    options = parser.parse_args(argv)
    kinds = [each for each in options.only or KINDS if each not in left_out()]
    with tempfile.TemporaryDirectory(prefix="chaos-") as folder:
        figures = ChaosRun(options.seed, options.seconds, kinds, Path(folder), options.keep).go()
    rows = [
        [each["time"], each["kind"], each["target"], each["forwarding_gap_ms"]]
        for each in figures["faults"]["list"]
    ]
    table(["s", "fault", "target", "gap ms"], rows)
    for each in figures["violations"]["list"]:
        print(f"{each['kind']}: {each['detail']}")
    print(f"{len(rows)} faults, {figures['violations']['count']} violations; {figures['operations']}")
    write_json(options.json, figures)
    return int(bool(figures["violations"]["count"]))


if __name__ == "__main__":
    sys.exit(main())
