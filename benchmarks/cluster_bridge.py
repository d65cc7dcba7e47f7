"""`benchmarks.cluster`: a bridge over 10 Mb/s with 50 ms each way, under load in both directions.

    steady     half of the link, reliable and best-effort items             rates, latencies
    cuts       the link is cut for 1 to 20 s, and neither end is told       pauses, losses
    kills      kill -9 of the bridge, which is started again a second later
    saturated  reliable items as fast as the bridge takes them, one direction after the other

Best-effort items that are lost meanwhile must be the gaps that readers count.
"""

import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

from benchmarks.cluster_bridge_stage import DIRECTIONS, ITEM_BYTES, KINDS, BridgeStage, Line

_SHARE: Final = 0.5
"""Of the link, in payload."""
_RELIABLE: Final = 2 / 3
"""Of the items."""
CUTS_S: Final = (1.0, 3.0, 8.0, 20.0)
_KILLS: Final = 3
_AWAY_S: Final = 1.0
_STEADY_S: Final = 20.0
_SATURATED_S: Final = 15.0
_WARM_S: Final = 10.0


def figures(rounds: int, scale: float, end: float) -> dict[str, Any]:
    """Losses, rates and pauses.

    Args:
        rounds: kills at most; each cut is made once.
        scale: of the times.
        end: no further cut or kill begins after this time (s, monotonic).
    """
    with tempfile.TemporaryDirectory(prefix="cluster-") as folder, BridgeStage(Path(folder)) as stage:
        items = _SHARE * stage.link.mbit * 1e6 / 8 / ITEM_BYTES
        load = (_RELIABLE * items, (1 - _RELIABLE) * items)
        stage.load(*load)
        stage.wait_whole()
        time.sleep(_WARM_S * scale)
        steady = _said("steady", stage.measure(_STEADY_S * scale))
        breaks: list[tuple[str, float]] = [("cut", scale * seconds) for seconds in CUTS_S]
        breaks += [("kill", _AWAY_S)] * min(rounds, _KILLS)
        pauses = [_broken(stage, *one) for one in breaks if time.monotonic() < end]
        saturated = _saturated(stage, scale)
        stage.load(*load)  # the last gap shows when something comes after it
        stage.wait_whole()
        stage.drain()
        sums = _said("sums", stage.sums())
        link = {"mbit": stage.link.mbit, "one_way_ms": 1000 * stage.link.one_way_s}
    counted = {name: counts(line) for name, line in sums.items()}
    return {
        "bridge_lost": sum(one["lost"] for one in counted.values()),
        "bridge_uncounted": sum(abs(one["missing"] - one["gaps"]) for one in counted.values()),
        "bridge_longest_pause_ms": max(max(one["pause_ms"].values()) for one in pauses),
        "bridge": {
            "link": link,
            "item_bytes": ITEM_BYTES,
            "steady": steady,
            "saturated": saturated,
            "pauses": pauses,
            "sums": counted,
        },
    }


def counts(line: Line) -> dict[str, int]:
    """What one direction has lost and counted.

    Args:
        line: its sums, as `BridgeStage.sums` gives them.

    Returns:
        Reliable items `written` and `lost`; best-effort items `missing` and those counted as `gaps`; `again` and
        `disordered`: reliable items that came twice, or after a later one.
    """
    reliable, best_effort = (line["got"][kind] for kind in KINDS)
    return {
        "written": line["written"]["reliable"],
        "lost": line["written"]["reliable"] - reliable["numbers"],
        "best_effort_written": line["written"]["best_effort"],
        "missing": line["written"]["best_effort"] - max(0, best_effort["first"]) - best_effort["numbers"],
        "gaps": line["gaps"],
        "again": reliable["again"],
        "disordered": reliable["disordered"],
    }


def _broken(stage: BridgeStage, fault: str, seconds: float) -> dict[str, Any]:
    pauses = stage.cut(seconds) if fault == "cut" else stage.kill_bridge(seconds)
    return dict(_said(fault, {"fault": fault, "seconds": seconds, "pause_ms": pauses}))


def _saturated(stage: BridgeStage, scale: float) -> dict[str, Any]:
    found = {}
    for name, (writer, _) in DIRECTIONS.items():
        stage.drain()
        stage.load(float("inf"), 0, [writer])
        time.sleep(_WARM_S * scale)
        measured = stage.measure(_SATURATED_S * scale)[name]
        del measured["offered_items_s"]  # all that the window takes, now and then
        found[name] = _said("saturated", measured)
    stage.drain()
    return found


def _said(what: str, value: Any) -> Any:
    print(f"{what}: {value}", file=sys.stderr, flush=True)
    return value
