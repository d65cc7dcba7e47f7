"""KitNET as published, one numpy call per step, per autoencoder and per packet.

Reference:
    Mirsky et al., Kitsune, NDSS 2018, section IV-C.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.cluster.hierarchy import linkage, to_tree

_Array = npt.NDArray[np.float64]


def _sigmoid(x: _Array) -> _Array:
    with np.errstate(over="ignore"):
        return np.asarray(1.0 / (1 + np.exp(-x)))


class _Autoencoder:
    def __init__(self, visible: int) -> None:
        hidden = math.ceil(visible * 0.75)
        self.weights = np.random.RandomState(1234).uniform(-1 / visible, 1 / visible, (visible, hidden))
        self.hidden_bias = np.zeros(hidden)
        self.visible_bias = np.zeros(visible)
        self.low = np.full(visible, np.inf)
        self.high = np.full(visible, -np.inf)

    def scaled(self, x: _Array) -> _Array:
        return np.asarray((x - self.low) / (self.high - self.low + 1e-16))

    def pass_through(self, x: _Array) -> tuple[_Array, _Array]:
        y = _sigmoid(np.dot(x, self.weights) + self.hidden_bias)
        z = _sigmoid(np.dot(y, self.weights.T) + self.visible_bias)
        return y, x - z

    def train(self, x: _Array) -> float:
        self.high[x > self.high] = x[x > self.high]
        self.low[x < self.low] = x[x < self.low]
        x = self.scaled(x)
        y, error = self.pass_through(x)
        gradient = np.dot(error, self.weights) * y * (1 - y)
        self.weights += 0.1 * (np.outer(x, gradient) + np.outer(error, y))
        self.hidden_bias += 0.1 * gradient
        self.visible_bias += 0.1 * error
        return float(np.sqrt(np.mean(error**2)))

    def score(self, x: _Array) -> float:
        _, error = self.pass_through(self.scaled(x))
        return float(np.sqrt(np.mean(error**2)))


class NaiveFeatureMap:
    """Groups features that go together, by hierarchical clustering of their correlations.

    Args:
        width: number of features.
    """

    def __init__(self, width: int) -> None:
        self.total = np.zeros(width)
        self.residual = np.zeros(width)
        self.squares = np.zeros(width)
        self.products = np.zeros((width, width))
        self.count = 0

    def update(self, x: _Array) -> None:
        """Learn from a packet's features, shape (width,)."""
        self.count += 1
        self.total += x
        residual = x - self.total / self.count
        self.residual += residual
        self.squares += residual**2
        self.products += np.outer(residual, residual)

    def groups(self, most: int) -> list[list[int]]:
        """Numbers of the features of each group, at most `most` in one."""
        roots = np.outer(np.sqrt(self.squares), np.sqrt(self.squares))
        roots[roots == 0] = 1e-100
        distance = 1 - self.products / roots
        distance[distance < 0] = 0
        upper = distance[np.triu_indices(len(distance), 1)]
        return split(to_tree(linkage(upper)), most)


def split(node: Any, most: int) -> list[list[int]]:
    """Leaves of a tree of `scipy.cluster.hierarchy.to_tree`, cut into parts of at most `most`."""
    if node.count <= most:
        return [node.pre_order()]
    return split(node.get_left(), most) + split(node.get_right(), most)


class NaiveKitNet:
    """Learns from the first packets, and scores the others.

    Args:
        width: number of features.
        most: features of one autoencoder at most.
        fm_grace: packets from which the groups are learnt.
        ad_grace: packets behind them, from which the autoencoders are.
    """

    def __init__(self, width: int, most: int, fm_grace: int, ad_grace: int) -> None:
        self.fm_grace, self.ad_grace, self.most = fm_grace, ad_grace, most
        self.map = NaiveFeatureMap(width)
        self.seen = 0
        self.groups: list[list[int]] = []
        self.ensemble: list[_Autoencoder] = []
        self.output = _Autoencoder(1)

    def process(self, x: _Array) -> float:
        """The score (RMSE) of a packet's features, shape (width,); 0.0 while learning."""
        if self.seen > self.fm_grace + self.ad_grace:
            self.seen += 1
            errors = np.array([a.score(x[g]) for a, g in zip(self.ensemble, self.groups, strict=True)])
            return self.output.score(errors)
        if not self.groups:
            self.map.update(x)
            if self.seen == self.fm_grace:
                self.groups = self.map.groups(self.most)
                self.ensemble = [_Autoencoder(len(group)) for group in self.groups]
                self.output = _Autoencoder(len(self.groups))
        else:
            errors = np.array([a.train(x[g]) for a, g in zip(self.ensemble, self.groups, strict=True)])
            self.output.train(errors)
        self.seen += 1
        return 0.0
