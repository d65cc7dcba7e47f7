"""Which fault comes when: drawn from a seed alone, so that a run can be repeated."""

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

CONTROLLERS = ("p4runtime_ctrl", "p4runtime_ctrl-b")
"""One works, the other stands by."""
APPS = ("coordinator", *CONTROLLERS, "kitsune", "sonata_adapter", "firewall", "dashboard")
PAIR = ("standby-a", "standby-b")
EVERY = ("switch", "updates", *APPS, *PAIR)
FIRST_S = 3.0
JUMP_S = 3600
"""How far a clock jumps, back or forth."""
_PAUSE_S = (4.0, 18.0)


@dataclass(frozen=True)
class FaultKind:
    """What can be drawn: whom it may hit, how many at once, how long it lasts (least and most seconds)."""

    targets: Sequence[str]
    weight: int = 1
    at_once: int = 1
    seconds: tuple[float, float] = (0.0, 0.0)


KINDS: Mapping[str, FaultKind] = {
    "kill": FaultKind(EVERY, weight=4),
    "kill_two": FaultKind(EVERY, weight=2, at_once=2),
    "stop": FaultKind(EVERY, weight=4, seconds=(1.0, 30.0)),
    "redis_empty": FaultKind(("updates",), weight=2),
    "cut": FaultKind(APPS, weight=2, seconds=(1.0, 10.0)),
    "slow": FaultKind(APPS, seconds=(5.0, 15.0)),
    "cut_switch": FaultKind(CONTROLLERS, seconds=(1.0, 10.0)),
    "slow_switch": FaultKind(CONTROLLERS, seconds=(5.0, 15.0)),
    "controllers_split": FaultKind(CONTROLLERS, weight=2, seconds=(5.0, 20.0)),
    "full_disk": FaultKind(("disk",), weight=2, seconds=(2.0, 15.0)),
    "clock": FaultKind((*APPS, "updates"), weight=2),
    "memory": FaultKind(APPS, weight=2, seconds=(5.0, 10.0)),
    "corrupt": FaultKind(APPS),
    "corrupt_archive": FaultKind(("archive",), seconds=(2.0, 10.0)),
}
"""Every kind of fault; `benchmarks.chaos_faults` carries them out."""


@dataclass(frozen=True)
class PlannedFault:
    """One fault: `at` seconds after the load began, lasting `seconds` (0: a blow)."""

    at: float
    kind: str
    targets: tuple[str, ...]
    seconds: float
    value: int = 0
    """Of a clock: seconds that it jumps."""


def schedule(seed: int, seconds: float, kinds: Sequence[str]) -> list[PlannedFault]:
    """The faults of a run; the same for the same arguments.

    Args:
        seed: of the draw.
        seconds: length of the run; no fault begins or lasts in its last tenth.
        kinds: names in `KINDS` that can be done on this machine.
    """
    draw = random.Random(seed)
    faults: list[PlannedFault] = []
    at, end = FIRST_S, 0.9 * seconds
    while at < end:
        name = draw.choices(kinds, [KINDS[each].weight for each in kinds])[0]
        kind = KINDS[name]
        lasts = min(draw.uniform(*kind.seconds), end - at)
        targets = tuple(draw.sample(list(kind.targets), kind.at_once))
        faults.append(
            PlannedFault(round(at, 2), name, targets, round(lasts, 2), draw.choice((-JUMP_S, JUMP_S)))
        )
        at += draw.uniform(*_PAUSE_S)
    return faults
