"""The life of Kitsune's model in words, from its health.  Pure."""

import time
from collections.abc import Iterator, Mapping
from typing import Any


def model_of(health: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """From the Coordinator's /health: what Kitsune says of its model; None if it does not."""
    app = health.get("apps", {}).get("kitsune", {}).get("health", {}).get("app", {})
    found = app.get("model")
    return found if isinstance(found, dict) else None


def headline(model: Mapping[str, Any]) -> str:
    """One line: `training 43 %, about 3 min left`, or since when it is trained; and whether scores have drifted."""
    if not model.get("done"):
        packets, wanted = int(model.get("packets", 0)), max(1, int(model.get("wanted", 1)))
        # never 100 % before it is done
        return f"training {min(99, 100 * packets // wanted)} %, {_left(model.get('seconds_left'), packets)}"
    trained = f"trained until {_minute(int(model.get('trained_at_us', 0)))}"
    return f"{trained}; SCORES HAVE DRIFTED" if model.get("drifted") else trained


def model_lines(model: Mapping[str, Any]) -> Iterator[str]:
    """All that an operator may want to know."""
    yield headline(model)
    if not model.get("done"):
        yield f"  {int(model.get('packets', 0)):,} of {int(model.get('wanted', 0)):,} packets"
    else:
        minutes, senders = float(model.get("trained_s", 0.0)) / 60, int(model.get("senders", 0))
        yield f"  on {minutes:,.0f} min of traffic of {senders:,} senders"
    for port in model.get("ports") or ():
        yield f"  {port['name']}: {int(port['packets']):,} packets of training"
    if beside := model.get("beside"):
        yield (
            f"  beside it a second model trains: {int(beside['packets']):,} of {int(beside['wanted']):,} packets, then "
            f"{int(beside['compared']):,} of {int(beside['to_compare']):,} are compared"
        )
    share, limit = model.get("drift_share"), model.get("drift_limit")
    if share is not None and limit is not None:
        yield (
            f"  last day: {share:.1%} of benign packets scored above what 1 % of training exceeded, in "
            f"{int(model.get('drift_blocks', 0))} half hours; drift from {limit:.0%} on"
        )
    if model.get("drifted"):
        yield (
            "  the network is not what it was in training: `sdnator model retrain --beside` trains a second model, "
            "which takes over if it is no worse"
        )


def _left(seconds: float | None, packets: int) -> str:
    if seconds is None:
        return "waiting for packets" if not packets else "time left unknown"
    if seconds < 90:
        return f"about {max(1, round(seconds))} s left"
    if seconds < 5_400:
        return f"about {round(seconds / 60)} min left"
    return (
        f"about {seconds / 3_600:.0f} h left"
        if seconds < 172_800
        else f"about {seconds / 86_400:.0f} days left"
    )


def _minute(time_us: int) -> str:
    return time.strftime("%Y-%m-%d %H:%M %Z", time.localtime(time_us / 1e6))
