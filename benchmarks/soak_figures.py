"""Samples of a soak run become figures: slopes of every process with their noise, losses, growth on disk.  Pure."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.soak_slope import Slope, medians, slope

Sample = Mapping[str, Any]
_SPAN_S = 60.0
_MEMORY = ("anonymous_kb", "pss_kb", "rss_kb")
_LEAST = 8
"""Minutes that a process must have lived: below, a slope says nothing."""


def figures(samples: Sequence[Sample], warm_s: float) -> dict[str, Any]:
    """What a run showed; see `benchmarks.soak` for the fields.

    Args:
        samples: as they were written, the first at the begin of the load.
        warm_s: seconds at the beginning that slopes leave out.

    Raises:
        ValueError: no samples.
    """
    if not samples:
        raise ValueError("no samples: the run ended before the first one")
    last, warm = samples[-1], [each for each in samples if each["seconds"] >= warm_s]
    names = sorted({name for each in samples for name in each["processes"]})
    found = {name: {kind: _of(warm, name, kind) for kind in _MEMORY} for name in names}
    judged = {name: kinds["anonymous_kb"] for name, kinds in found.items()}
    first = warm[0] if warm else last
    hours = max(last["seconds"] - first["seconds"], 1e-9) / 3600
    return {
        "seconds": last["seconds"],
        "warm_s": warm_s,
        "pps": last["sent"] / max(last["seconds"], 1e-9),
        "slope_kb_per_hour": {name: each.value for name, each in judged.items() if each},
        "noise": {name: each.noise for name, each in judged.items() if each},
        "interval_kb_per_hour": {name: [each.low, each.high] for name, each in judged.items() if each},
        "growing": [name for name, each in judged.items() if each and each.grows],
        "not_judged": [name for name, each in judged.items() if each is None],
        "pss_slope_kb_per_hour": {
            name: each["pss_kb"].value for name, each in found.items() if each["pss_kb"]
        },
        "rss_slope_kb_per_hour": {
            name: each["rss_kb"].value for name, each in found.items() if each["rss_kb"]
        },
        "second_half": _second_half(warm, names),
        "memory": {name: _ends(samples, name, "anonymous_kb", warm_s) for name in names},
        "files": {name: _ends(samples, name, "files", warm_s) for name in names},
        "threads": {name: _ends(samples, name, "threads", warm_s) for name in names},
        "more_files": _more(warm, names, "files"),
        "more_threads": _more(warm, names, "threads"),
        "lost": sum(last["lost"].values()),
        "lost_by_kind": last["lost"],
        "restarts": last["restarts"],
        "bytes": {
            name: {"end": size, "per_hour": (size - first["bytes"][name]) / hours}
            for name, size in last["bytes"].items()
        },
        "traffic": {name: last[name] for name in ("sent", "came", "stopped")},
        "client": last["client"],
        "samples": len(samples),
    }


def _of(samples: Sequence[Sample], name: str, kind: str) -> Slope | None:
    """Per hour, from the medians of whole minutes; None for a process that was there too shortly."""
    there = [each for each in samples if name in each["processes"]]
    times, values = medians(
        [each["seconds"] for each in there], [each["processes"][name][kind] for each in there], _SPAN_S
    )
    return slope([at / 3600 for at in times], values) if len(times) >= _LEAST else None


def _second_half(samples: Sequence[Sample], names: Sequence[str]) -> dict[str, dict[str, float]]:
    """The same of the later half: a cache that fills shows in the first one only, a leak in both."""
    half = samples[len(samples) // 2 :]
    found = {name: _of(half, name, "anonymous_kb") for name in names}
    return {
        name: {"slope_kb_per_hour": each.value, "noise": each.noise, "low": each.low}
        for name, each in found.items()
        if each
    }


def _ends(samples: Sequence[Sample], name: str, kind: str, warm_s: float) -> dict[str, float]:
    seen = [(each["seconds"], each["processes"][name][kind]) for each in samples if name in each["processes"]]
    return {
        "begin": next((value for at, value in seen if at >= warm_s), math.nan),
        "end": seen[-1][1],
        "most": max(value for _, value in seen),
    }


def _more(samples: Sequence[Sample], names: Sequence[str], kind: str) -> list[str]:
    """Processes of which a count is higher in all of the last tenth than ever in the first tenth."""
    tenth = max(1, len(samples) // 10)
    found = []
    for name in names:
        begin, end = (
            [each["processes"][name][kind] for each in part if name in each["processes"]]
            for part in (samples[:tenth], samples[-tenth:])
        )
        if begin and end and min(end) > max(begin):
            found.append(name)
    return found


def lost_in(health: Mapping[str, Any]) -> dict[str, int]:
    """From the Coordinator's /health: what apps say they have lost."""
    found = dict.fromkeys(("gaps", "dropped_slow", "unpublished", "disconnected", "archive", "packet_ins"), 0)
    for name, told in health.get("apps", {}).items():
        engine = told.get("health", {}).get("engine", {})
        app = told.get("health", {}).get("app", {})
        receiving = engine.get("receiving", {})
        found["gaps"] += receiving.get("gaps", 0)
        found["dropped_slow"] += receiving.get("dropped_slow", 0)
        found["unpublished"] += engine.get("unpublished", 0)
        found["disconnected"] += engine.get("updates", {}).get("lost_disconnected", 0)
        found["archive"] += engine.get("archive", {}).get("lost", 0)
        switches = app.get("switches") if name == "p4runtime_ctrl" else None
        found["packet_ins"] += sum(int(each.get("lost", 0)) for each in switches or ())
    return found
