"""What a SYN flood costs the host while no guard stands: processor time for each million SYNs.

The firewall only reports its guards (`syn.challenge` off, the one deviation from the default settings), so that the
flood goes on unhindered; its sources are forged, so that nobody is blocked.  What the same parts use while nothing
happens is subtracted.  The switch itself is left out: it is not the host.
"""

import tempfile
import time
from pathlib import Path
from typing import Any, Final

from sdnator.demos.syn_flood.demo import guard, start_product, terminable
from sdnator.demos.syn_flood.lab import PLANS, Lab
from sdnator.demos.syn_flood.stage import FloodStage
from sdnator.demos.syn_flood.trial import Trial, TrialHosts

_LEARNING, _FLOODED = 1, 4
_IDLE_S: Final = 5.0
_FLOOD_S: Final = 8.0
_RATES: Final = (1000, 5000)


def host_cost() -> dict[str, Any]:
    """`host_cpu_s_per_million_syns` at 5,000 SYNs a second, and at each rate, without the guard."""
    with (
        tempfile.TemporaryDirectory(prefix="sdnator-syn-cost-") as made,
        terminable(),
        Lab() as lab,
        FloodStage(lab, Path(made), switch="embedded", guard=guard(max(_RATES))) as stage,
    ):
        services = [PLANS[4].service(number) for number in range(1, 20)]
        field = TrialHosts(stage, services)
        start_product(stage, [], syn={"challenge": False})
        field.learn([4], lambda version: PLANS[version].service(_LEARNING))
        field.aim(services[0], known_rate=0.0, new_rate=0.0)
        stage.settle(10.0)
        before = _host_s(stage)
        field.watch(_IDLE_S)
        idle = (_host_s(stage) - before) / _IDLE_S
        costs = {rate: _cost(stage, field, rate, number, idle) for number, rate in enumerate(_RATES)}
    return {
        "host_cpu_s_per_million_syns": costs[max(_RATES)],
        "host_cpu_s_per_million_syns_by_rate": costs,
        "host_cpu_idle_share": round(idle, 4),
    }


def _cost(stage: FloodStage, field: TrialHosts, rate: int, number: int, idle: float) -> float:
    begin, since = _host_s(stage), time.monotonic()
    trial = Trial(
        sources="spoofed",
        service=_FLOODED + number,
        seconds=_FLOOD_S,
        rate=rate,
        known_rate=0.0,
        new_rate=0.0,
        protection="none",
    )
    outcome = field.run(trial)
    stage.settle(5.0)
    used = _host_s(stage) - begin - idle * (time.monotonic() - since)
    return round(used / outcome.sent * 1e6, 1)


def _host_s(stage: FloodStage) -> float:
    return sum(seconds for name, seconds in stage.cpu_seconds().items() if name != "switch")
