"""The whole pipeline under load and faults: `python -m benchmarks.chaos --json FILE --seconds N --seed S`.

    schedule (seed) ──► faults ──► pipeline of `sdnator up` ◄── load and probes ──► record ──► checker

A seeded scheduler draws fault and moment (`chaos_schedule`), `chaos_faults` carries them out on the parts of
`chaos_stage`, `chaos_probes` and `chaos_frames` note what was promised and what came, and `chaos_checker`
holds one against the other.  Exit code 1 where a promise was broken.

`forwarding_gap_ms` is the longest run of frames by fault that the switch lost or forwarded later than half a second,
`machine_gap_ms` that of the same frames at the same time through a program that only copies them: on a busy machine
both have gaps.  `none` is what came before the first fault.  The archive reaches its limit within half an hour: `pruned`
counts what that has taken, of which nothing may be in force.  Ctrl-C and SIGTERM end the faults early, and judge
what was; after each fault the file has the figures so far (`"unfinished": true`).
"""

import argparse
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.chaos_checker import Violation, check, longest_gaps
from benchmarks.chaos_faults import ACTIONS, FaultAction, left_out
from benchmarks.chaos_frames import LATE_S, ForwardingProbe
from benchmarks.chaos_probes import Probes, until
from benchmarks.chaos_schedule import CONTROLLERS, KINDS, PAIR, PlannedFault, schedule
from benchmarks.chaos_stage import PREFIX, ChaosStage, remove_orphans
from benchmarks.faults_stage import ChildProgram
from benchmarks.measure import machine, table, write_json
from sdnator.capture.interfaces import VethPair

_LOOK_S = 0.05
_SETTLE_S = 90.0
_WARM_S = 30.0
_AGAIN_S = 1.0
_REACHES_SWITCH = ("switch", *CONTROLLERS, "firewall", "updates", "coordinator", "disk")
_PROGRESS_S = 60.0


class ChaosRun:
    """One run; `go` returns its figures."""

    def __init__(
        self,
        seed: int,
        seconds: float,
        kinds: Sequence[str],
        folder: Path,
        keep: Path | None = None,
        report: Path | None = None,
    ) -> None:
        self._seed, self._seconds = seed, seconds
        self._faults = schedule(seed, seconds, kinds)
        self._folder = folder
        self._keep = keep
        self._report = report
        self._asked_to_end = threading.Event()
        self._asked_before = False
        self._excused = 0
        self._stack = ExitStack()
        self._pair: dict[str, ChildProgram] = {}
        self._pair_dead: dict[str, float] = {}
        self._spoken = 0
        self._begun: list[tuple[float, PlannedFault]] = []
        self._settled_s = float("nan")
        self._breaking_since = float("nan")

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
            self._wire = self._forwarding(self._stage.wires, self._probes.blocked)
            self._control = self._forwarding(self._stage.control, list)
            self._look_for(_WARM_S)
            self._break()
            self._settle()
            if self._keep is not None:
                shutil.copytree(self._stage.disk, self._keep, ignore=_no_sockets, dirs_exist_ok=True)
            return self._figures()

    def end_early(self) -> None:
        """No more faults: settle, and judge what was.  Raises KeyboardInterrupt when asked again."""
        if self._asked_before:
            raise KeyboardInterrupt
        self._asked_before = True
        self._asked_to_end.set()

    @staticmethod
    def _forwarding(
        wires: tuple[VethPair, VethPair] | None, blocked: Callable[[], list[str]]
    ) -> ForwardingProbe | None:
        if wires is None:
            return None
        entry, leave = wires
        probe = ForwardingProbe(entry.near, leave.far, blocked)
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
        while time.monotonic() < deadline and not self._asked_to_end.is_set():
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
        began = self._breaking_since = time.monotonic()
        told = began + _PROGRESS_S
        lasting: list[tuple[float, FaultAction]] = []
        for fault in [*self._faults, None]:
            due = began + (fault.at if fault is not None else self._seconds)
            while (now := time.monotonic()) < due and not self._asked_to_end.is_set():
                for ends, action in [each for each in lasting if each[0] <= now]:
                    action.end()
                    lasting.remove((ends, action))
                self._excuse()
                self._look()
                if now >= told:
                    told = now + _PROGRESS_S
                    self._tell(now - began)
            if self._asked_to_end.is_set():
                break
            if fault is not None:
                lasting.append((now + fault.seconds, self._begin(fault, now)))
        for _, action in lasting:
            action.end()
        self._excuse()

    def _begin(self, fault: PlannedFault, now: float) -> FaultAction:
        targets = "+".join(fault.targets)
        print(f"{fault.at:7.1f} s  {fault.kind:12} {targets}", file=sys.stderr, flush=True)
        action = ACTIONS[fault.kind](fault, self._stage, self._pid)
        self._begun.append((now, fault))
        action.begin()
        write_json(self._report, {"unfinished": True, **self._so_far()})
        return action

    def _excuse(self) -> None:
        for copy in self._stage.restored[self._excused :]:
            self._probes.excuse(copy)
            self._excused += 1

    def _so_far(self) -> dict[str, Any]:
        return {
            "seed": self._seed,
            "faults": {"count": len(self._begun), "planned": len(self._faults)},
            "operations": self._operations(),
            "restarts": self._restarts(),
        }

    def _tell(self, seconds: float) -> None:
        done, restarts = self._operations(), sum(self._restarts().values())
        print(
            f"{seconds:7.1f} s  of {self._seconds:.0f}: {len(self._begun)} of {len(self._faults)} faults,"
            f" {restarts} restarts, {done['delivered']} delivered, {done['answers']} of {done['instructions']} answers",
            file=sys.stderr,
            flush=True,
        )

    def _restarts(self) -> dict[str, int]:
        return {each.name: each.restarts for each in self._stage.supervisor.reports()}

    def _settle(self) -> None:
        """Faults have ended: the load ends, and what was promised may arrive."""
        began = time.monotonic()
        self._asked_to_end.clear()
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
        for probe in (self._wire, self._control):
            if probe is not None:
                probe.close()

    def _figures(self) -> dict[str, Any]:
        record = self._probes.record
        record.away = self._stage.away()
        record.switch_faults = [
            at + fault.seconds
            for at, fault in self._begun
            if any(name in _REACHES_SWITCH for name in fault.targets)
        ]
        gaps, machine_gaps = self._gaps(self._wire), self._gaps(self._control)
        if self._wire is not None:
            record.passed = self._wire.passed
        found = check(record)
        return {
            "faults": {
                "count": len(self._begun),
                "planned": len(self._faults),
                "list": [self._told(number, gaps, machine_gaps) for number in range(len(self._begun))],
            },
            "violations": {"count": len(found), "list": [_as_map(each) for each in found]},
            "forwarding_gap_ms": self._gap_by_target(gaps),
            "machine_gap_ms": self._gap_by_target(machine_gaps),
            "forwarding_lost_ms": self._gap_by_target(self._gaps(self._wire, float("inf"))),
            "machine_lost_ms": self._gap_by_target(self._gaps(self._control, float("inf"))),
            "gaps": self._longest(self._wire),
            "machine_gaps": self._longest(self._control),
            "seed": self._seed,
            "seconds": self._seconds,
            "settled_s": self._settled_s,
            "operations": self._operations(),
            "restarts": self._restarts(),
            "supervisor": self._stage.told,
            "probe_errors": self._probes.errors,
            "left_out": left_out(),
            "archives_restored": self._excused,
            "numbers_excused": len(record.excused - set(record.archived)),
            "addresses_excused": sorted(record.forgotten),
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
            "pruned": sum(self._probes.pruned.values()),
            "frames_sent": len(self._wire.sent) if self._wire else 0,
            "frames_forwarded": len(self._wire.came) if self._wire else 0,
            "frames_of_blocked_sources_passed": len(self._wire.passed) if self._wire else 0,
        }

    def _gaps(self, probe: ForwardingProbe | None, late_s: float = LATE_S) -> dict[int, float]:
        """Longest gap in ms by fault: a gap is that of the last fault that had begun, -1 for none."""
        longest: dict[int, float] = {}
        for at, length in probe.gaps(late_s) if probe is not None else []:
            index = max((n for n, (begun, _) in enumerate(self._begun) if begun <= at + 0.05), default=-1)
            longest[index] = max(longest.get(index, 0.0), length)
        return longest

    def _longest(self, probe: ForwardingProbe | None) -> list[dict[str, float]]:
        return longest_gaps(probe.gaps(), self._breaking_since) if probe is not None else []

    def _gap_by_target(self, gaps: dict[int, float]) -> dict[str, float]:
        found = {"none": gaps.get(-1, 0.0)}
        for index, (_, fault) in enumerate(self._begun):
            name = "+".join(sorted(fault.targets))
            found[name] = max(found.get(name, 0.0), gaps.get(index, 0.0))
        return found if self._wire is not None else {}

    def _told(self, number: int, gaps: dict[int, float], machine_gaps: dict[int, float]) -> dict[str, Any]:
        fault = self._begun[number][1]
        return {
            "time": fault.at,
            "kind": fault.kind,
            "target": "+".join(fault.targets),
            "seconds": fault.seconds,
            "forwarding_gap_ms": gaps.get(number, 0.0),
            "machine_gap_ms": machine_gaps.get(number, 0.0),
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
    remove_orphans()
    with tempfile.TemporaryDirectory(prefix=f"{PREFIX}{os.getpid()}-") as folder:
        run = ChaosRun(options.seed, options.seconds, kinds, Path(folder), options.keep, options.json)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: run.end_early())
        figures = run.go()
    rows = [
        [each[name] for name in ("time", "kind", "target", "forwarding_gap_ms", "machine_gap_ms")]
        for each in figures["faults"]["list"]
    ]
    table(["s", "fault", "target", "gap ms", "machine ms"], rows)
    for name in ("forwarding_gap_ms", "machine_gap_ms"):
        print(f"{name} before the first fault: {figures[name].get('none', 0.0):.0f}")
    for each in figures["violations"]["list"]:
        print(f"{each['kind']}: {each['detail']}")
    print(f"{len(rows)} faults, {figures['violations']['count']} violations; {figures['operations']}")
    write_json(options.json, figures)
    return int(bool(figures["violations"]["count"]))


if __name__ == "__main__":
    sys.exit(main())
