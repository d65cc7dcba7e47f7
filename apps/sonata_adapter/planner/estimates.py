"""Packets a second by condition, to choose which queries gain most from counting in the switch.

Measured where something counts them.  Elsewhere rough shares of all packets (10,000 a second of mixed traffic where
these are not measured either): shares of the classifier's fields, multiplied; they need to be right to an order of
magnitude only, since they order queries and decide nothing else.
"""

from collections.abc import Iterable, Mapping
from typing import Any, Final

from apps.sonata_adapter.planner.rates import MeasuredRates

PACKETS: Final = 10_000.0
_PROTOCOLS: Final = {6: 0.75, 17: 0.2, 1: 0.02, 58: 0.01}
_ETHERTYPES: Final = {0x0800: 0.85, 0x86DD: 0.13, 0x0806: 0.01}
_PORTS: Final = {22: 0.01, 23: 0.0005, 53: 0.05, 80: 0.15, 443: 0.4}
_OTHER_PORT: Final = 0.001
_FLAGS: Final = {(0x02, 0x17): 0.04, (0x12, 0x17): 0.04, (0x10, 0x17): 0.85, (0x01, 0x07): 0.06}
_ONE_HOST: Final = 0.01


def packets_per_second(matches: Iterable[Mapping[str, Any]], rates: MeasuredRates | None = None) -> float:
    """How many packets meet at least one of the conditions, at most."""
    every = rates.of({}) if rates is not None else None
    packets = PACKETS if every is None else every
    found = 0.0
    for match in matches:
        measured = rates.of(match) if rates is not None else None
        found += packets * _share(match) if measured is None else measured
    return found if every is None and rates is not None else min(packets, found)


def _share(match: Mapping[str, Any]) -> float:
    share = _PROTOCOLS.get(match.get("protocol", 0), 1.0 if "protocol" not in match else 0.01)
    if "protocol" not in match:
        share *= _ETHERTYPES.get(match.get("ethertype", 0), 1.0 if "ethertype" not in match else 0.01)
    for name in ("sport", "dport"):
        low, high = match.get(name, (0, 65_535))
        if low == high:
            share *= _PORTS.get(low, _OTHER_PORT)
    if "tcp_flags" in match:
        share *= _FLAGS.get(tuple(match["tcp_flags"]), 0.1)
    for name in ("src", "dst"):
        if name in match:
            share *= _ONE_HOST
    return share
