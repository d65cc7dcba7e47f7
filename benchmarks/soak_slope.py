"""The slope of a series and how well it is known: Theil-Sen, with an interval from a block bootstrap.  Pure."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
_DRAWS = 400
_BLOCKS = 8
_STUDENT = 3.707
"""Student's t for 99 % and `_BLOCKS` - 2 degrees of freedom: ten processes are judged, none to be accused by chance."""


@dataclass(frozen=True)
class Slope:
    """Units of the series per unit of time, with the ends of an interval that has it in 99 of 100 cases."""

    value: float
    low: float
    high: float

    @property
    def grows(self) -> bool:
        """Whether noise alone does not explain it."""
        return self.low > 0.0

    @property
    def noise(self) -> float:
        """Half the interval."""
        return (self.high - self.low) / 2


def slope(times: Sequence[float], values: Sequence[float], seed: int = 1) -> Slope:
    """Theil-Sen slope; the interval draws blocks of residuals, since neighbours in time resemble each other.

    Args:
        times: ascending, evenly spaced.
        values: as many.
        seed: of the draws.

    Raises:
        ValueError: fewer than 8 values.

    Reference:
        Theil 1950, Sen 1968; Kuensch, The jackknife and the bootstrap for general stationary observations, 1989.
    """
    if len(times) < _BLOCKS:
        raise ValueError(f"a slope needs {_BLOCKS} values or more: {len(times)}")
    x, y = np.asarray(times, np.float64), np.asarray(values, np.float64)
    first, second = np.triu_indices(len(x), 1)
    apart = x[second] - x[first]

    def steepness(series: Floats) -> float:
        return float(np.median((series[second] - series[first]) / apart))

    found = steepness(y)
    rest = y - found * x
    rest -= np.median(rest)
    random = np.random.default_rng(seed)
    drawn = [steepness(_resampled(rest, random)) for _ in range(_DRAWS)]
    # few blocks, of residuals that the line has taken two degrees of freedom from, vary less than the noise does
    half = _STUDENT * float(np.std(drawn)) * (_BLOCKS / (_BLOCKS - 2)) ** 0.5
    return Slope(found, found - half, found + half)


def _resampled(rest: Floats, random: np.random.Generator) -> Floats:
    """As long as `rest`, of blocks of it that begin anywhere."""
    length = -(-len(rest) // _BLOCKS)
    starts = random.integers(0, len(rest) - length + 1, _BLOCKS)
    return np.concatenate([rest[start : start + length] for start in starts])[: len(rest)]


def medians(times: Sequence[float], values: Sequence[float], width: float) -> tuple[list[float], list[float]]:
    """The median of each whole span of `width`, and its middle."""
    spans: dict[int, list[float]] = {}
    for at, value in zip(times, values, strict=True):
        spans.setdefault(int(at // width), []).append(value)
    numbers = sorted(spans)[:-1] if len(spans) > 1 else sorted(spans)
    return [(number + 0.5) * width for number in numbers], [float(np.median(spans[n])) for n in numbers]
