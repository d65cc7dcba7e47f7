"""How well scores tell attack from benign: the measures of the table in the Kitsune paper (NDSS 2018)."""

import numpy as np
from numpy.typing import NDArray

from sdnator.replay.summary import roc_auc


def measures(attack: NDArray[np.bool_], score: NDArray[np.float64]) -> dict[str, float | None]:
    """ROC AUC, true-positive rate at false-positive rates 0 and 0.001, and equal error rate.

    A threshold counts packets that score above it.  None where one class is missing.
    """
    names = ("auc", "tpr_at_fpr_0", "tpr_at_fpr_0.001", "equal_error_rate")
    if attack.all() or not attack.any():
        return dict.fromkeys(names)
    values = (
        roc_auc(attack, score),
        tpr_at(attack, score, 0.0),
        tpr_at(attack, score, 0.001),
        eer(attack, score),
    )
    return dict(zip(names, values, strict=True))


def tpr_at(attack: NDArray[np.bool_], score: NDArray[np.float64], fpr: float) -> float:
    """Share of attack packets above the lowest line that at most a share `fpr` of benign packets exceeds."""
    benign = np.sort(score[~attack])[::-1]
    line = benign[min(int(fpr * len(benign)), len(benign) - 1)]
    return float(np.mean(score[attack] > line))


def eer(attack: NDArray[np.bool_], score: NDArray[np.float64]) -> float:
    """Where as large a share of benign packets is above the threshold as of attack packets below it."""
    lines = np.unique(score)
    missed = np.searchsorted(np.sort(score[attack]), lines, side="right") / np.count_nonzero(attack)
    alarmed = 1 - np.searchsorted(np.sort(score[~attack]), lines, side="right") / np.count_nonzero(~attack)
    nearest = int(np.argmin(np.abs(missed - alarmed)))
    return float((missed[nearest] + alarmed[nearest]) / 2)
