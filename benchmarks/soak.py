"""Hours of `sdnator up` at half of what it can carry: `python -m benchmarks.soak --json FILE --seconds N`.

    office traffic ──► veth ──► pipeline of `sdnator up` ──► veth ──► what came
    an operator, a reader of scores and of a query ──┘ └── /proc of every process, each few seconds ──► samples

Before it is measured the load trains Kitsune, and fills its tables with hosts that come once, and those of the firewall and
the controller with known sources (`benchmarks.soak_fill`), while the operator is hasty; `--no-fill` leaves that out: state
that is bounded would grow for hours otherwise, and look like a leak.

Fields: `seconds`, `pps`; `fill_s`, `fill_frames` (0: not filled), `fill_scored` (of them, by Kitsune), `fill_tables`
(entries and caps then); by process `slope_kb_per_hour` (of its anonymous memory, Theil-Sen over the medians of
minutes), `noise` (half of the 99 % interval of a block bootstrap) and `growing` (the interval lies above zero: empty
is the bar); `lost` (frames of nobody who was blocked, and what apps say they lost); `files`, `threads`, `bytes`
(archive, logs, rest of the state).  Samples are appended to a file: `--from FILE` makes figures of a run that was
cut off.  SIGTERM and Ctrl-C end a run early, with its figures.  Exit code 1: something grows or was lost.
Linux, root.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from benchmarks.measure import machine, table, write_json
from benchmarks.soak_client import SoakClient
from benchmarks.soak_figures import figures, lost_in
from benchmarks.soak_fill import FRAMES, TRAINED, fill_frames, fullness
from benchmarks.soak_memory import folder_bytes, footprints
from benchmarks.soak_traffic import LATE_S, OfficeLoad
from benchmarks.worker import end_in_order
from sdnator.capture.interfaces import VethPair
from sdnator.errors import PipelineError
from sdnator.northbound import ask
from sdnator.up import running

_START_S = 180.0
_STEPS_PPS = (250, 500, 1000, 2000, 4000, 8000)
_STEP_S = 10.0
_SETTLE_S = 5.0
_CARRIED = 0.98
_TOLD_S = 15.0
"""Until frames are late, and apps have said how full they are."""
_PROGRESS_S = 300.0
_WARM_S = 3600.0
"""Bounded state fills first: Kitsune keeps an idle stream for 3,000 s, producers retain up to 16 MiB of an hour."""


class Ended(Exception):
    """SIGTERM or SIGINT came."""


class SoakRun:
    """One run in a folder of its own; a context manager.

    Args:
        folder: of state, data and configuration of the pipeline.
        seed: of the traffic.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self._folder = folder
        self._seed = seed
        self._stack = ExitStack()
        self._health: Mapping[str, Any] = {}

    def __enter__(self) -> "SoakRun":
        try:
            near, far = VethPair.make(self._stack, "sn"), VethPair.make(self._stack, "sf")
            self._up(f"1=veth:{near.far}", f"2=veth:{far.near}")
            found = self._running()
            self.client = SoakClient(self._folder / "client", found.updates, found.archive)
            self._stack.callback(self.client.close)
            self.load = OfficeLoad(near.near, far.far, self._seed)
            self._stack.callback(self.load.close)
            self.client.start()
            self.load.start()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _up(self, *ports: str) -> None:
        places = {
            f"XDG_{name}_HOME": str(self._folder / name.lower()) for name in ("STATE", "DATA", "CONFIG")
        }
        command = [str(Path(sys.executable).with_name("sdnator")), "up", "--json"]
        for each in ports:
            command += ["--port", each]
        with (self._folder / "up.log").open("wb") as log:
            self._process = subprocess.Popen(
                command,
                env={**os.environ, **places},
                cwd=self._folder,
                stdout=log,
                stderr=log,
                # Ctrl-C is for the benchmark, which ends it in order
                start_new_session=True,
            )
        self._stack.callback(self._end_up)

    def _end_up(self) -> None:
        end_in_order(self._process)

    def _running(self) -> running.Running:
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline and self._process.poll() is None:
            found = running.find(self._folder / "state" / "sdnator")
            if found is not None and found.coordinator:
                return found
            time.sleep(0.1)
        raise SystemExit(f"soak: no pipeline: {(self._folder / 'up.log').read_text()[-2000:]}")

    def sample(self, seconds: float) -> dict[str, Any]:
        """What there is now."""
        found = self._running()
        with suppress(PipelineError):
            self._health = ask(found.coordinator, "/health")
        self.load.look(self.client.blocked())
        state = self._folder / "state" / "sdnator"
        logs = folder_bytes(state / "logs")
        client = self.client
        return {
            "seconds": seconds,
            "time": time.time(),
            "machine_load": os.getloadavg()[0],
            "processes": footprints(self._process.pid, {pid: name for name, pid in found.parts.items()}),
            "bytes": {
                "archive": folder_bytes(self._folder / "data"),
                "logs": logs,
                "state": folder_bytes(state) - logs,
            },
            "restarts": sum(int(each.get("restarts", 0)) for each in found.health.values()),
            "sent": self.load.sent,
            "came": self.load.came,
            "stopped": self.load.stopped,
            "lost": {"frames": self.load.missed, **lost_in(self._health)},
            "scored": self._scored(),
            "client": {
                "scores": client.scores,
                "results": client.results,
                "asked": client.asked,
                "answered": client.answered,
                "refused": client.refused,
                "decisions": client.decisions,
                "errors": len(client.errors),
            },
        }

    def _scored(self) -> int:
        told = self._health.get("apps", {}).get("kitsune", {}).get("health", {}).get("app", {})
        return int(told.get("packets", 0))

    def capacity(self) -> float:
        """The highest rate, in frames a second, that was forwarded and scored whole; 0: not even the lowest."""
        carried = 0.0
        for pps in _STEPS_PPS:
            before = self.sample(0.0)
            self.load.pps = pps
            time.sleep(_STEP_S)
            self.load.pps = 0.0
            time.sleep(max(_SETTLE_S, LATE_S))
            after = self.sample(0.0)
            sent, came, scored = (after[name] - before[name] for name in ("sent", "came", "scored"))
            print(
                f"{pps:6} frames/s: {sent / _STEP_S:.0f}/s sent, {came / max(sent, 1):.2%} forwarded,"
                f" {scored / max(sent, 1):.2%} scored",
                file=sys.stderr,
                flush=True,
            )
            if sent < _CARRIED * pps * _STEP_S or min(came, scored) < _CARRIED * sent:
                break
            carried = float(pps)
        return carried

    def fill(self, pps: float) -> dict[str, Any]:
        """Train Kitsune and fill tables, at so many frames a second; what that took and came to."""
        began, before = time.monotonic(), self.sample(0.0)
        self._send(TRAINED, pps)
        self.load.insert(fill_frames())
        with self.client.hasty():
            self._send(FRAMES, pps)
        time.sleep(_TOLD_S)
        after = self.sample(0.0)
        found = {
            "fill_s": round(time.monotonic() - began, 1),
            "fill_frames": after["sent"] - before["sent"],
            "fill_scored": after["scored"] - before["scored"],
            "fill_tables": fullness(self._health),
        }
        print(f"filled: {found}", file=sys.stderr, flush=True)
        return found

    def _send(self, frames: int, pps: float) -> None:
        """So many, and as many more as are sent until that is seen."""
        end = self.load.sent + frames
        self.load.pps = pps
        while self.load.sent < end:
            time.sleep(0.1)
        self.load.pps = 0.0

    def soak(self, pps: float, seconds: float, every_s: float, samples: Path) -> None:
        """Load for so long; each sample is appended to a file."""
        began, told = time.monotonic(), 0.0
        before = self.sample(0.0)
        self.load.pps = pps
        with samples.open("a", encoding="utf-8") as file:
            while (now := time.monotonic() - began) < seconds:
                sample = self.sample(now)
                _without(sample, before)
                file.write(json.dumps(sample) + "\n")
                file.flush()
                if now >= told:
                    told += _PROGRESS_S
                    _tell(sample)
                time.sleep(max(0.0, every_s - (time.monotonic() - began - now)))


def _without(sample: dict[str, Any], before: Mapping[str, Any]) -> None:
    """Leaves out what was sent, and lost by too much of it, to find the capacity."""
    for name in ("sent", "came", "stopped"):
        sample[name] -= before[name]
    for name, count in before["lost"].items():
        sample["lost"][name] -= count


def _tell(sample: Mapping[str, Any]) -> None:
    total = sum(each["anonymous_kb"] for each in sample["processes"].values()) / 1024
    print(
        f"{sample['seconds']:7.0f} s  {sample['sent']:,} sent, {sample['scored']:,} scored, lost {sample['lost']},"
        f" {total:.0f} MiB, archive {sample['bytes']['archive'] / 1e6:.0f} MB, load {sample['machine_load']:.1f}",
        file=sys.stderr,
        flush=True,
    )


def read_samples(path: Path) -> list[dict[str, Any]]:
    """All whole lines."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").rpartition("\n")[0].splitlines()]


def main(argv: Sequence[str] | None = None) -> int:
    """Run, print, write; 1 where something grows or was lost."""
    options = _options(argv)
    if options.source is None:
        options.source = options.samples or (options.json or Path("soak.json")).with_suffix(".samples.jsonl")
        options.source.unlink(missing_ok=True)
        more = _run(options)
    else:
        more = {}
    samples = read_samples(options.source)
    if options.warm is None:
        options.warm = min(_WARM_S, samples[-1]["seconds"] / 2) if samples else 0.0
    found = {
        **figures(samples, options.warm),
        **more,
        "samples_file": str(options.source),
        "machine": machine(),
    }
    _show(found)
    write_json(options.json, found)
    return int(bool(found["growing"] or found["lost"] or found["more_files"] or found["more_threads"]))


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="benchmarks.soak", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--seconds", type=float, default=7200.0, help="length of the load")
    parser.add_argument("--pps", type=float, help="frames a second; default: half of what a probe finds")
    parser.add_argument(
        "--no-fill", dest="fill", action="store_false", help="begin with empty tables instead of full ones"
    )
    parser.add_argument("--every", type=float, default=5.0, help="seconds between two samples")
    parser.add_argument(
        "--warm",
        type=float,
        help="first seconds, which slopes leave out; default: 3,600, at most half of the run",
    )
    parser.add_argument("--seed", type=int, default=1, help="of the traffic")
    parser.add_argument("--samples", type=Path, help="file for samples; default: beside the figures")
    parser.add_argument("--from", dest="source", type=Path, help="figures of the samples of an earlier run")
    parser.add_argument("--keep", type=Path, help="folder that takes the logs after the run")
    return parser.parse_args(argv)


def _run(options: argparse.Namespace) -> dict[str, Any]:
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _raise_ended)
    more: dict[str, Any] = {"ended_early": False, "fill_s": 0.0, "fill_frames": 0}
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        try:
            with SoakRun(Path(folder), options.seed) as run:
                pps = options.pps
                if pps is None:
                    more["capacity_pps"] = run.capacity()
                    pps = more["capacity_pps"] / 2
                if options.fill and pps > 0:
                    more.update(run.fill(pps))
                print(f"{pps:g} frames/s for {options.seconds:g} s", file=sys.stderr, flush=True)
                run.soak(pps, options.seconds, options.every, options.source)
                more["errors"] = run.client.errors
        except Ended:
            more["ended_early"] = True
        if options.keep is not None:
            shutil.copytree(Path(folder) / "state" / "sdnator" / "logs", options.keep, dirs_exist_ok=True)
    return more


def _raise_ended(*_: object) -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)
    raise Ended


def _show(found: Mapping[str, Any]) -> None:
    rows = [
        [
            name,
            found["memory"][name]["end"],
            found["slope_kb_per_hour"].get(name, "-"),
            found["noise"].get(name, "-"),
            found["second_half"].get(name, {}).get("slope_kb_per_hour", "-"),
            found["files"][name]["end"],
            found["threads"][name]["end"],
        ]
        for name in found["memory"]
    ]
    table(["process", "kB", "kB/h", "noise", "later half", "files", "threads"], rows)
    print(
        f"{found['seconds']:.0f} s at {found['pps']:.0f} frames/s; lost {found['lost_by_kind']}; {found['bytes']}"
    )
    print(f"growing: {', '.join(found['growing']) or 'nothing'}")


if __name__ == "__main__":
    sys.exit(main())
