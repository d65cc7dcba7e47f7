"""Rate limits in force on generated traffic: what the meters of the switch program would drop."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from apps.messages import Decision
from sdnator.replay.limits import ModelledLimit


class ModelledLimits:
    """All of them, by the decision's id."""

    def __init__(self) -> None:
        self._limits: dict[str, ModelledLimit] = {}

    def decide(self, decisions: Iterable[Decision]) -> None:
        """Set, extend or lift."""
        for decision in decisions:
            if decision.action == "unmeter":
                self._limits.pop(decision.id, None)
            elif decision.limit is not None and decision.id not in self._limits:
                self._limits[decision.id] = ModelledLimit(decision.target.address, decision.limit)

    def over(self, columns: Mapping[str, Any], blocked: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Which packets one of them drops, of those that no block drops."""
        found = np.zeros(len(blocked), np.bool_)
        for limit in self._limits.values():
            found |= limit.over(columns, ~blocked & ~found)
        return found

    def counters(self) -> dict[str, int]:
        """Drop counters by decision."""
        return {name: limit.dropped for name, limit in self._limits.items()}
