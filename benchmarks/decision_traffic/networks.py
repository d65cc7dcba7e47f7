"""The benign networks by name."""

from collections.abc import Callable, Mapping
from typing import Final

from benchmarks.decision_traffic.factory import factory
from benchmarks.decision_traffic.house import house
from benchmarks.decision_traffic.network import Network
from benchmarks.decision_traffic.office import office

NETWORKS: Final[Mapping[str, Callable[[int], Network]]] = {"house": house, "office": office}
"""To tune on."""
HELD_BACK_NETWORKS: Final[Mapping[str, Callable[[int], Network]]] = {"factory": factory}
"""Whoever tunes decisions must not look at results of these."""
