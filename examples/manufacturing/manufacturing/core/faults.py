"""What goes wrong in a printer, and how its two sensors show it before the print is ruined.

Faults begin after so many hours of printing, drawn per printer; the clock of a fault runs while the printer prints.
    clog:   the filament flow falls
    heater: the nozzle loses temperature
    slip:   the feeder slips, so that the flow becomes erratic
A print that goes on `ruin_s` after the beginning is ruined, and so is every later one until maintenance.
"""

from functools import cache
from typing import Final, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from manufacturing.core.orders import HOUR

FaultKind = Literal["clog", "heater", "slip"]
_KINDS: Final[tuple[FaultKind, ...]] = ("clog", "heater", "slip")
MEAN_H: Final = 25.0
"""Mean hours of printing between faults of one printer."""
RUIN_S: Final = (900.0, 1800.0)
"""Printing time from the beginning of a fault to a ruined print: least, most."""
MAINTENANCE_S: Final = 2_700.0

TEMPERATURE_SD: Final = 0.5
FLOW_SD: Final = 0.02
_WAVE_S: Final = 900.0
_WAVE_C: Final = 0.4
_HEATER_C_MIN: Final = 0.5
_CLOG_MIN: Final = 0.015
_SLIP: Final = 5.0


class PrinterFault(msgspec.Struct, frozen=True):
    """One fault of one printer, in seconds of its printing."""

    kind: FaultKind
    onset: float
    ruin: float
    """When it begins to ruin prints."""


def draw(seed: int, machine: int, number: int, printed: float) -> PrinterFault:
    """The next fault of a printer that has printed for so long; `number` counts its faults."""
    random = np.random.default_rng((seed, 3, machine, number))
    onset = printed + float(random.exponential(MEAN_H * HOUR))
    return PrinterFault(_KINDS[int(random.integers(3))], onset, onset + float(random.uniform(*RUIN_S)))


@cache
def _own_errors(seed: int, machine: int) -> tuple[float, float]:
    """Errors of a printer's two sensors."""
    found = np.random.default_rng((seed, 4, machine)).normal(0, (1.0, 0.02))
    return float(found[0]), float(found[1])


def readings(
    seed: int, machine: int, step: int, printed: NDArray[np.float64], fault: PrinterFault | None
) -> NDArray[np.float64]:
    """Deviation of the nozzle from its target in °C, and filament flow as a share of what is commanded.

    Args:
        seed: of the scenario.
        machine: its number; each printer has small errors of its own.
        step: number of the batch of readings, for the noise.
        printed: of each reading, seconds that the printer has printed in its life, shape (n,).
        fault: the current or next one.

    Returns:
        Both, rounded as the sensors give them, shape (n, 2).
    """
    if not len(printed):
        return np.zeros((0, 2))
    own = _own_errors(seed, machine)
    noise = np.random.default_rng((seed, 5, machine, step)).standard_normal((len(printed), 2))
    temperature = own[0] + _WAVE_C * np.sin(2 * np.pi * printed / _WAVE_S) + TEMPERATURE_SD * noise[:, 0]
    flow_noise = FLOW_SD * noise[:, 1]
    flow = np.full(len(printed), 1 + own[1])
    if fault is not None and printed[-1] > fault.onset:
        minutes = np.maximum(0.0, printed - fault.onset) / 60
        if fault.kind == "heater":
            temperature -= np.minimum(40.0, _HEATER_C_MIN * minutes)
        elif fault.kind == "clog":
            flow -= np.minimum(0.8, _CLOG_MIN * minutes)
        else:
            flow_noise = np.where(minutes > 0, _SLIP, 1.0) * flow_noise
    return np.column_stack((np.round(temperature, 2), np.round(np.maximum(0.0, flow + flow_noise), 4)))
