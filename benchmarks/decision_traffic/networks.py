"""The benign networks by name."""

from collections.abc import Callable, Mapping
from typing import Final

from benchmarks.decision_traffic.house import house
from benchmarks.decision_traffic.network import Network
from benchmarks.decision_traffic.office import office

NETWORKS: Final[Mapping[str, Callable[[int], Network]]] = {"house": house, "office": office}
