"""Sampling rates, as exporters tell them: in options, by the number of a sampler, or in the record itself."""

from typing import Final

import numpy as np

from flow_records.columns import MOST_SAMPLING, Numbers
from flow_records.decoding.data_sets import DataSet

MOST_SAMPLERS: Final = 64
# elements of IPFIX, and of NetFlow v9 where it has them
_INTERVAL, _RANDOM_INTERVAL = 34, 50
_SAMPLER, _SELECTOR = 48, 302
_PACKET_INTERVAL, _PACKET_SPACE = 305, 306
_SIZE, _POPULATION = 309, 310


class SamplingRates:
    """The rates of one exporter's domain.

    Args:
        rate: where nothing is told.
    """

    def __init__(self, rate: int) -> None:
        self._rate = rate
        self._samplers: dict[int, int] = {}
        self._domain: int | None = None

    def learn(self, options: DataSet) -> None:
        """Note what records of options say; of samplers beyond MOST_SAMPLERS nothing is kept."""
        rates = _told(options)
        if rates is None:
            return
        names = options.number(_SAMPLER, _SELECTOR)
        if names is None:
            self._domain = int(rates[-1]) if len(rates) else self._domain
            return
        for name, rate in zip(names.tolist(), rates.tolist(), strict=True):
            if name in self._samplers or len(self._samplers) < MOST_SAMPLERS:
                self._samplers[name] = rate

    def of(self, records: DataSet) -> Numbers:
        """The rate of each record, shape (n,)."""
        told = _told(records)
        if told is not None:
            return told
        names = records.number(_SAMPLER, _SELECTOR)
        if names is None or not self._samplers:
            return np.full(records.size, self._fallback())
        found = np.full(records.size, self._fallback())
        for name, rate in self._samplers.items():
            found[names == np.uint64(name)] = rate
        return found

    def _fallback(self) -> int:
        if self._domain is not None:
            return self._domain
        return next(iter(self._samplers.values())) if len(self._samplers) == 1 else self._rate


def _told(records: DataSet) -> Numbers | None:
    """Rates in the records themselves, 1 to MOST_SAMPLING; None: they have none."""
    rate = records.number(_INTERVAL, _RANDOM_INTERVAL)
    if rate is None:
        rate = _ratio(records, _PACKET_INTERVAL, _PACKET_SPACE, added=True)
    if rate is None:
        rate = _ratio(records, _SIZE, _POPULATION, added=False)
    return None if rate is None else np.clip(rate, 1, MOST_SAMPLING).astype(np.int64)


def _ratio(records: DataSet, part: int, rest: int, *, added: bool) -> Numbers | None:
    """`rest / part`, or `(part + rest) / part`; 1 where that makes no sense."""
    taken, other = records.number(part), records.number(rest)
    if taken is None or other is None:
        return None
    divisor = np.maximum(taken, 1).astype(np.float64)
    return np.round(other / divisor + (1.0 if added else 0.0))
