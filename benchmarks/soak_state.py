"""Where the memory of apps ends: `python -m benchmarks.soak_state --json FILE [--part NAME]`, ten minutes.

    office traffic, as in `benchmarks.soak` ──► time stamps of 4,000 packets a second ──► Detector
    what comes of it, and what a soak run's client asks for ──► services of firewall, Sonata adapter and Coordinator
                                                             └► what the controller keeps of a switch

A soak run of two hours ends while tables still fill; here hours of its traffic pass in minutes, in a process for each
part.  `mib` is the process' anonymous memory in each span, `later_mib_per_hour` its slope over the last third, by the
hours that the traffic would have taken, `noise` half of that slope's 99 % interval; `growing`: it lies above zero, of
all parts their names.  Traffic on its way through the process takes some of the memory, now more and now less: the
least of each span counts.  `health` is what a service said of itself where the last third begins and at the end,
`--objects` counts Python's objects then.
"""

import argparse
import logging
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.decision_traffic.networks import NETWORKS
from benchmarks.decisions_core import SWITCH, detector_for
from benchmarks.measure import arguments, machine, table, write_json
from benchmarks.soak_slope import slope
from benchmarks.soak_state_parts import OTHERS, PARTS, run_all
from due import RecordBatch

PPS = 4_000
TRAINING = 55_000
_PACKETS = 100_000_000
_SPANS = 60
_ROWS = 4_096
_MORNING_S = 9 * 3600
_END_S = 365 * 86_400
_START_US = 1_700_000_000_000_000


def main(argv: Sequence[str] | None = None) -> int:
    """Feed, print, write; 1 where memory still grows at the end."""
    parser = arguments("soak_state", __doc__, rounds=1)
    parser.add_argument("--packets", type=int, default=_PACKETS, help="how many to feed to Kitsune")
    parser.add_argument("--part", choices=("all", *PARTS), default="all", help="whose memory")
    parser.add_argument("--objects", action="store_true", help="count objects, of the parts but Kitsune")
    options = parser.parse_args(argv)
    if options.part == "all":
        return _all(options)
    if options.part in OTHERS:
        return _other(options)
    packets = round(options.scale * options.packets)
    least = [float("inf")] * _SPANS
    for fed in _feed(packets):
        span = min(_SPANS - 1, fed * _SPANS // packets)
        least[span] = min(least[span], _anonymous_mib())
    spans = [(at + 0.5, mib) for at, mib in enumerate(least) if mib < float("inf")]
    hours = packets / PPS / 3600 / _SPANS
    last = spans[len(spans) * 2 // 3 :]
    later = slope([at * hours for at, _ in last], [mib for _, mib in last])
    figures = {
        "machine": machine(),
        "packets": packets,
        "hours": round(packets / PPS / 3600, 2),
        "mib": [round(mib, 1) for _, mib in spans],
        "later_mib_per_hour": round(later.value, 2),
        "noise": round(later.noise, 2),
        "growing": later.grows,
    }
    table(
        ["hours", "MiB"],
        [(round(at * hours, 2), round(mib)) for at, mib in spans[:: max(1, len(spans) // 12)]],
    )
    print(f"last third: {figures['later_mib_per_hour']} MiB an hour, ± {figures['noise']}")
    write_json(options.json, figures)
    return int(later.grows)


def _all(options: argparse.Namespace) -> int:
    """All parts; 1 where one of them grows."""
    given = ["--packets", str(options.packets), "--scale", str(options.scale)]
    parts = run_all([*given, *(["--objects"] if options.objects else [])])
    growing = [name for name, found in parts.items() if found["growing"]]
    _show(parts)
    print(f"growing: {', '.join(growing) or 'nothing'}")
    write_json(options.json, {"machine": machine(), "growing": growing, "parts": parts})
    return int(bool(growing))


def _other(options: argparse.Namespace) -> int:
    """A part that is not Kitsune's; 1 where it grows."""
    found = OTHERS[options.part](options.scale, objects=options.objects)
    _show({options.part: found})
    write_json(options.json, {"machine": machine(), **found})
    return int(found["growing"])


def _show(parts: Mapping[str, Mapping[str, Any]]) -> None:
    table(
        ["part", "hours", "MiB", "at the end", "an hour", "noise"],
        [
            [
                name,
                found["hours"],
                found["mib"][0],
                found["mib"][-1],
                found["later_mib_per_hour"],
                found["noise"],
            ]
            for name, found in parts.items()
        ],
    )


def _feed(packets: int) -> Iterator[int]:
    """Have the detector process so many; how many were, after each piece of traffic."""
    detector, fed = detector_for(TRAINING), 0
    for part in NETWORKS["office"](1).chunks(_MORNING_S, _END_S):
        columns = dict(part.columns)
        numbers = fed + np.arange(len(part))
        columns["time_us"] = (_START_US + numbers * 1_000_000 // PPS).astype(columns["time_us"].dtype)
        columns["arrival"] = (numbers + 1).astype(columns["arrival"].dtype)
        for start in range(0, len(part), _ROWS):
            rows = {name: column[start : start + _ROWS] for name, column in columns.items()}
            detector.process(RecordBatch(rows), SWITCH)
            detector.take_evidence()
        fed += len(part)
        yield fed
        if fed >= packets:
            return


def _anonymous_mib() -> float:
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("Anonymous:")) / 1024


if __name__ == "__main__":
    # what services say of blocks and notices is not asked for here
    logging.getLogger().addHandler(logging.NullHandler())
    sys.exit(main())
