"""How long the steps of a print take, as planned and as it turns out.

    setup (another kind) → heat-up → printing → clean-up

What turns out differs from the plan by noise that depends on the job and the attempt, not on the printer or the
scheduler: all schedulers meet the same prints, and a bound can know them in advance.
"""

from typing import Final

import numpy as np

from manufacturing.core.orders import ALL_SETUP_S, Task

FLOW_MM3_S: Final = 6.0
"""Volume that a 0.4 mm nozzle lays down, mm³/s."""
CLEAN_UP_S: Final = 360.0
"""To take the part off and clean the plate."""
NOISE: Final = 0.05
"""Standard deviation of the logarithm of printing time against the slicer's estimate."""
AMBIENT_C: Final = 22.0
HEAT_C_S: Final = 1.6
COOL_S: Final = 300.0
"""Time constant of a nozzle that cools."""


def planned_printing_s(volume: float) -> float:
    """The slicer's estimate for a part of so many cm³, s."""
    return volume * 1_000 / FLOW_MM3_S


def planned_s(task: Task) -> float:
    """Printing and clean-up as planned, without setup and heat-up, s."""
    return planned_printing_s(task.volume) + CLEAN_UP_S


def setup_s(kind: int, loaded: int) -> float:
    """Seconds to set a printer up that has `loaded`, -1 for nothing."""
    return 0.0 if kind == loaded else ALL_SETUP_S[kind]


def printing_s(seed: int, task: Task) -> float:
    """How long the printing of this attempt takes, s."""
    random = np.random.default_rng((seed, 2, task.order, task.number, task.attempt))
    return round(planned_printing_s(task.volume) * float(np.exp(random.normal(0, NOISE))), 3)


def nozzle_cooled(from_c: float, seconds: float) -> float:
    """Temperature of a nozzle after its heater was off for so long, °C."""
    return AMBIENT_C + (from_c - AMBIENT_C) * float(np.exp(-seconds / COOL_S))


def heat_up_s(from_c: float, to_c: float) -> float:
    """Seconds to heat a nozzle, 0 where it is hot enough."""
    return round(max(0.0, to_c - from_c) / HEAT_C_S, 3)
