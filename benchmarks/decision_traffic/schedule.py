"""When things happen, and small helpers for rows of different length.

Periodic events keep their phase over hours without any state: an hour holds those whose nominal time is in it.
"""

import zlib
from typing import Final

import numpy as np

from benchmarks.decision_traffic.traffic import SECOND, Ints

Random = np.random.Generator
FIRST_HOUR: Final = 10
"""Hour of the day, and Monday, at second 0."""


def chance(seed: int, *names: str | int) -> Random:
    """A source of chance for one purpose, independent of all others of the same seed."""
    numbers = [zlib.crc32(name.encode()) if isinstance(name, str) else name for name in names]
    return np.random.default_rng([seed, *numbers])


def every(
    random: Random, start: int, end: int, period_s: float, *, spread_s: float = 0.0, phase: float = 0.0
) -> Ints:
    """Times about every `period_s`, each shifted by up to `spread_s`; `phase` (0 to 1) of the period."""
    period = period_s * SECOND
    first = int(np.ceil(start / period - phase))
    last = int(np.ceil(end / period - phase))
    times = (np.arange(first, last) + phase) * period
    if spread_s:
        times = times + random.uniform(0, spread_s * SECOND, len(times))
    found: Ints = times.astype(np.int64)
    return found


def poisson(random: Random, start: int, end: int, per_hour: float) -> Ints:
    """Times of a Poisson process, in order."""
    expected = per_hour * (end - start) / (3_600 * SECOND)
    count = int(random.poisson(max(expected, 0.0)))
    times: Ints = np.sort(random.uniform(start, end, count)).astype(np.int64)
    return times


def hour_of_day(time: int) -> float:
    """0 to 24."""
    return (time / SECOND / 3_600 + FIRST_HOUR) % 24


def is_weekend(time: int) -> bool:
    """Saturday or Sunday."""
    return int((time / SECOND / 3_600 + FIRST_HOUR) // 24) % 7 >= 5


def lognormal(random: Random, median: float, sigma: float, count: int, most: float) -> Ints:
    """Whole numbers from 1 to `most`, half of them below `median`."""
    found: Ints = np.clip(median * np.exp(random.normal(0, sigma, count)), 1, most).astype(np.int64)
    return found


def within(counts: Ints) -> Ints:
    """0, 1, … counts[0]-1, 0, 1, … counts[1]-1, …"""
    return np.arange(int(counts.sum()), dtype=np.int64) - np.repeat(np.cumsum(counts) - counts, counts)


def before(values: Ints, counts: Ints) -> Ints:
    """Sum of the values before each, within groups of `counts` consecutive values."""
    sums = np.cumsum(values) - values
    firsts = np.cumsum(counts) - counts
    starts = sums[np.minimum(firsts, max(len(sums) - 1, 0))] if len(sums) else np.zeros(len(counts), np.int64)
    found: Ints = sums - np.repeat(starts, counts)
    return found


def spread_ms(random: Random, count: int, low_ms: float, high_ms: float) -> Ints:
    """Microseconds, uniform between two numbers of milliseconds."""
    return random.uniform(low_ms * 1_000, high_ms * 1_000, count).astype(np.int64)
