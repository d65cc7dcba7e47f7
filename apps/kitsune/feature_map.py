"""The feature map: correlated features share an autoencoder, at most `max_size` together."""

from typing import Any

import numpy as np
import numpy.typing as npt

_Array = npt.NDArray[np.float64]
_TINY = 1e-100


class FeatureMapper:
    """Learns correlations between `width` features, one packet after another, and clusters them.

    The order of operations is the published one, so that ties between equally correlated features
    break alike.
    """

    def __init__(self, width: int) -> None:
        self._sum = np.zeros(width)
        self._residual = np.zeros(width)
        self._squares = np.zeros(width)
        self._products = np.zeros((width, width))
        self.packets = 0

    def learn(self, features: _Array) -> None:
        """Adds rows of features, in order."""
        for row in features:
            self.packets += 1
            self._sum += row
            residual = row - self._sum / self.packets
            self._residual += residual
            self._squares += residual**2
            self._products += np.outer(residual, residual)

    def distances(self) -> _Array:
        """Correlation distance between all pairs of features, 0 to 2."""
        roots = np.sqrt(self._squares)
        scale = np.outer(roots, roots)
        scale[scale == 0] = _TINY  # a constant feature correlates with no other
        distance = 1 - self._products / scale
        distance[distance < 0] = 0
        return np.asarray(distance)

    def cluster(self, max_size: int) -> list[list[int]]:
        """Groups of feature numbers, each at most `max_size` long.

        Raises `ValueError` when a feature was NaN or infinite while the map was learnt.
        """
        distance = self.distances()
        if not np.isfinite(distance).all():
            bad = np.flatnonzero(~np.isfinite(np.diagonal(distance))).tolist()
            raise ValueError(
                f"feature map: features {bad} were not finite among the first {self.packets} packets; "
                "remove these packets or train on another part of the capture"
            )
        left, right, sizes = single_linkage(distance)
        return split_tree(left, right, sizes, max_size)


def single_linkage(distance: _Array) -> tuple[list[int], list[int], list[int]]:
    """Merge tree of nearest neighbours: left child, right child and size of each inner node.

    Leaves are 0..n-1, inner nodes n..2n-2 in order of height.  Ties go to the lowest index (Prim's
    algorithm from leaf 0, stable sort by height), and the smaller node number is the left child.
    """
    count = len(distance)
    edges = sorted(_spanning_tree(distance), key=lambda edge: edge[2])
    parent = list(range(2 * count - 1))
    sizes = [1] * count
    left: list[int] = []
    right: list[int] = []
    for first, second, _ in edges:
        a, b = sorted((_root(parent, first), _root(parent, second)))
        node = count + len(left)
        parent[a] = parent[b] = node
        left.append(a)
        right.append(b)
        sizes.append(sizes[a] + sizes[b])
    return left, right, sizes[count:]


def _spanning_tree(distance: _Array) -> list[tuple[int, int, float]]:
    count = len(distance)
    nearest = np.full(count, np.inf)
    outside = np.ones(count, dtype=bool)
    here = 0
    edges: list[tuple[int, int, float]] = []
    for _ in range(count - 1):
        outside[here] = False
        nearest = np.minimum(nearest, np.where(outside, distance[here], np.inf))
        candidates: npt.NDArray[Any] = np.where(outside, nearest, np.inf)
        following = int(np.argmin(candidates))
        edges.append((here, following, float(candidates[following])))
        here = following
    return edges


def _root(parent: list[int], node: int) -> int:
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


def split_tree(left: list[int], right: list[int], sizes: list[int], max_size: int) -> list[list[int]]:
    """Cuts the tree from the root, left first, until no part has more than `max_size` leaves."""
    count = len(left) + 1
    groups: list[list[int]] = []
    stack = [2 * count - 2]
    while stack:
        node = stack.pop()
        if node < count or sizes[node - count] <= max_size:
            groups.append(_leaves(node, left, right))
        else:
            stack += (right[node - count], left[node - count])
    return groups


def _leaves(root: int, left: list[int], right: list[int]) -> list[int]:
    count = len(left) + 1
    leaves: list[int] = []
    stack = [root]
    while stack:
        node = stack.pop()
        if node < count:
            leaves.append(node)
        else:
            stack += (right[node - count], left[node - count])
    return leaves
