"""What `KitNet.moved_most` finds, row by row, in Python."""

from typing import Any

import numpy as np
import numpy.typing as npt

from apps.kitsune.kitnet import KitNet

_Row = npt.NDArray[np.float64]


def moved_most(model: KitNet, features: _Row, errors: _Row) -> list[int]:
    """The two autoencoders with the highest errors, and the feature of each that is farthest from the middle."""
    output: Any = model.output
    excess = (errors - output.low[0]) / (output.high[0] - output.low[0] + 1e-16)
    worst = np.argsort(-excess)[:2].tolist()
    farthest = [_farthest(model, features, autoencoder) for autoencoder in worst]
    return [*worst, *farthest] if len(worst) == 2 else [worst[0], -1, farthest[0], -1]


def _farthest(model: KitNet, features: _Row, autoencoder: int) -> int:
    ensemble: Any = model.ensemble
    group = np.array(model.feature_map[autoencoder])
    low, high = ensemble.low[autoencoder, : len(group)], ensemble.high[autoencoder, : len(group)]
    scaled = (features[group] - low) / (high - low + 1e-16)
    return int(group[np.argmax(np.abs(scaled - 0.5))])
