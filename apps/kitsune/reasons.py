"""The reason of an alert as text."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, overload

import numpy as np
import numpy.typing as npt

from apps.kitsune.kernel import LAMBDAS
from apps.kitsune.kitnet import KitNet
from apps.kitsune.names import ip_text, mac_text
from apps.kitsune.senders import AnomalousSecond

_GROUPS: Final = (
    (0, 3, "packets from this MAC and address"),
    (15, 7, "packets from this host to that host"),
    (50, 3, "gaps between packets of the two hosts"),
    (65, 7, "packets from this socket to that socket"),
)
_STATISTICS: Final = (
    "rate",
    "mean size",
    "spread of sizes",
    "joint spread",
    "joint size",
    "covariance",
    "correlation",
)
_GAP_STATISTICS: Final = ("number", "mean", "spread")
_NOTABLE: Final = 2.0
"""A rate or fan-out of at least this many times its training maximum is mentioned."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """The packet with the highest score of a second, as the autoencoders saw it."""

    features: npt.NDArray[np.float64]
    errors: npt.NDArray[np.float64]


class Explanations(Sequence[Explanation]):
    """Explanations of several packets of one batch.

    Args:
        features: their features, row by row.
        errors: RMSE of each autoencoder.
    """

    def __init__(self, features: npt.NDArray[np.float64], errors: npt.NDArray[np.float64]) -> None:
        self._features, self._errors = features, errors

    def __len__(self) -> int:
        return len(self._features)

    @overload
    def __getitem__(self, row: int) -> Explanation: ...
    @overload
    def __getitem__(self, row: slice) -> "Explanations": ...
    def __getitem__(self, row: int | slice) -> "Explanation | Explanations":
        if isinstance(row, slice):
            return Explanations(self._features[row], self._errors[row])
        return Explanation(self._features[row], self._errors[row])


def feature_words(feature: int) -> str:
    """A feature described in words."""
    start, per_scale, group = max(entry for entry in _GROUPS if entry[0] <= feature)
    scale, statistic = divmod(feature - start, per_scale)
    names = _GAP_STATISTICS if start == 50 else _STATISTICS
    return f"{names[statistic]} of {group} over {round(1 / LAMBDAS[scale], 1):g} s"


def reason(second: AnomalousSecond, model: KitNet, threshold: float) -> str:
    """What the sender did, and the autoencoders and features with the highest errors."""
    tally, record = second.tally, second.record
    _, _, mac, address = record.identity
    who = ip_text(*address) or mac_text(mac)
    parts = _comparisons(who, tally.packets, record.training_rate, tally.hosts, record.training_destinations)
    parts.append(
        f"{tally.over} of {tally.packets} packets scored over {threshold:.3g}, the highest {tally.peak:.3g}"
    )
    if isinstance(tally.evidence, Explanation):
        parts.append(_autoencoders(tally.evidence, model))
    return "; ".join(parts)


def _comparisons(who: str, packets: int, trained_packets: int, hosts: int, trained_hosts: int) -> list[str]:
    if not trained_packets:
        towards = {0: "", 1: " to 1 host"}.get(hosts, f" to {hosts} hosts")
        return [f"{who} was never seen in training and sends {packets} packets/s{towards}"]
    parts = []
    if trained_hosts and hosts >= _NOTABLE * trained_hosts:
        parts.append(f"{who} sends to {hosts / trained_hosts:.0f} times more hosts than in training")
    if packets >= _NOTABLE * trained_packets:
        parts.append(f"{who} sends {packets / trained_packets:.0f} times more packets than in training")
    return parts or [f"{who} sends no more than in training, but differently"]


def _autoencoders(evidence: Explanation, model: KitNet) -> str:
    ensemble, output = model.ensemble, model.output
    if ensemble is None or output is None:
        return "no model"
    excess = (evidence.errors - output.low[0]) / (output.high[0] - output.low[0] + 1e-16)
    worst = np.argsort(-excess)[:2].tolist()
    words = [feature_words(_most_moved(evidence.features, model, autoencoder)) for autoencoder in worst]
    return f"autoencoders {' and '.join(map(str, worst))} moved most: " + ", ".join(dict.fromkeys(words))


def _most_moved(features: npt.NDArray[np.float64], model: KitNet, autoencoder: int) -> int:
    ensemble: Any = model.ensemble
    group = np.array(model.feature_map[autoencoder])
    low, high = ensemble.low[autoencoder, : len(group)], ensemble.high[autoencoder, : len(group)]
    scaled = (features[group] - low) / (high - low + 1e-16)
    return int(group[np.argmax(np.abs(scaled - 0.5))])
