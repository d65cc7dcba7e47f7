"""KitNET: an ensemble of autoencoders learns what is normal; their errors are the anomaly score.

Training sees every packet once: first a map of features is learnt (`fm_grace` + 1 packets), then the
autoencoders (`ad_grace` packets), then packets are scored.  Source: Mirsky et al., NDSS 2018, and
its published implementation; given equal features, scores agree within 1e-12.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from apps.kitsune.feature_map import FeatureMapper
from apps.kitsune.kernel import Kernel, contiguous, load_kernel

_Array = npt.NDArray[np.float64]
_SEED = 1234
_UNSOUND = "KitNET: the layers do not fit each other or the features; train again"
_LANES = 16
"""Rows that the kernel scores at a time."""


@dataclass
class Layer:
    """Autoencoders of one layer, padded to a common size."""

    inputs: tuple[tuple[int, ...], ...]
    """Feature numbers of each autoencoder's inputs."""
    weights: _Array
    hidden_bias: _Array
    visible_bias: _Array
    low: _Array
    high: _Array
    index: npt.NDArray[np.int32] = field(init=False)
    visible_of: npt.NDArray[np.int32] = field(init=False)
    hidden_of: npt.NDArray[np.int32] = field(init=False)

    def __post_init__(self) -> None:
        count, visible, _ = self.weights.shape
        self.visible_of = np.array([len(group) for group in self.inputs], dtype=np.int32)
        self.hidden_of = hidden_units(self.visible_of)
        self.index = np.zeros((count, visible), dtype=np.int32)
        for row, group in zip(self.index, self.inputs, strict=True):
            row[: len(group)] = group

    @classmethod
    def fresh(cls, inputs: Sequence[Sequence[int]]) -> "Layer":
        """Untrained: every autoencoder draws its weights from the same seed, as published."""
        groups = tuple(tuple(group) for group in inputs)
        sizes = np.array([len(group) for group in groups])
        count, visible, hidden = len(groups), int(sizes.max()), int(hidden_units(sizes).max())
        weights = np.zeros((count, visible, hidden))
        for autoencoder, size in enumerate(sizes.tolist()):
            units = int(hidden_units(np.array([size]))[0])
            bound = 1 / size
            draw = np.random.RandomState(_SEED).uniform(low=-bound, high=bound, size=(size, units))
            weights[autoencoder, :size, :units] = draw
        low, high = np.full((count, visible), np.inf), np.full((count, visible), -np.inf)
        return cls(groups, weights, np.zeros((count, hidden)), np.zeros((count, visible)), low, high)


def hidden_units(visible: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
    """Three quarters of the inputs, rounded up."""
    return np.array([math.ceil(0.75 * size) for size in visible.tolist()], dtype=np.int32)


class KitNet:
    """The detector on feature rows: trains itself on the first packets, then scores.

    Args:
        width: number of features per packet.
        fm_grace, ad_grace: packets for the feature map and for the autoencoders; `fm_grace` + 1 +
            `ad_grace` packets get no score, as published.
        max_ae: most inputs of one autoencoder, at least 1.
        feature_map: groups of feature numbers; leaves out learning the map.  The autoencoders then
            train on all `fm_grace` + 1 + `ad_grace` packets, as published.
        clip: limit of scaled inputs when scoring; 0 = none, as published (a feature that was constant
            in training then scores near 1e16 when it first moves).
        kernel: None loads the one that was built.
    """

    learning_rate = 0.1

    def __init__(
        self,
        width: int = 100,
        *,
        fm_grace: int = 5_000,
        ad_grace: int = 50_000,
        max_ae: int = 10,
        feature_map: Sequence[Sequence[int]] | None = None,
        clip: float = 0.0,
        kernel: Kernel | None = None,
    ) -> None:
        if fm_grace < 1 or ad_grace < 1:
            raise ValueError(f"fm_grace={fm_grace} and ad_grace={ad_grace}: both must be at least 1")
        self.width = width
        self.fm_grace, self.ad_grace, self.max_ae = fm_grace, ad_grace, max(1, max_ae)
        self.clip = clip
        self.trained = 0
        self._kernel = kernel or load_kernel()
        self._mapper = FeatureMapper(width)
        self.feature_map: list[list[int]] = []
        self.ensemble: Layer | None = None
        self.output: Layer | None = None
        self._in_c: tuple[Layer, Layer, list[Any], list[Any]] | None = None
        if feature_map is not None:
            self._build(feature_map)

    @property
    def training_packets(self) -> int:
        """How many packets get no score."""
        return self.fm_grace + self.ad_grace + 1

    @property
    def is_trained(self) -> bool:
        return self.trained >= self.training_packets

    def process(self, features: _Array) -> tuple[_Array, _Array]:
        """Trains on or scores rows of features, in order.

        Returns the scores (RMSE; 0.0 for training packets) and the RMSE of each autoencoder (an
        array without rows until the first packet is scored).
        """
        taught = min(len(features), self.training_packets - self.trained)
        if not taught:
            return self.score(features)
        self.learn(features[:taught])
        scores, errors = self.score(features[taught:])
        return np.concatenate([np.zeros(taught), scores]), errors

    def learn(self, features: _Array) -> None:
        """Trains on rows of features, in order; raises `ValueError` for rows of another width."""
        self._check_width(features)
        if not self.feature_map:
            share = features[: self.fm_grace + 1 - self._mapper.packets]
            self._mapper.learn(share)
            self.trained += len(share)
            features = features[len(share) :]
            if self._mapper.packets == self.fm_grace + 1:
                self._build(self._mapper.cluster(self.max_ae))
        if len(features):
            self._train(contiguous(features, "f8"))
            self.trained += len(features)

    def retrain(self, fm_grace: int, ad_grace: int) -> None:
        """Trains on from where it is, with the same feature map, for another `training_packets`."""
        self.fm_grace, self.ad_grace, self.trained = fm_grace, ad_grace, 0

    def score(self, features: _Array) -> tuple[_Array, _Array]:
        """Scores rows of features without learning; needs a finished feature map."""
        self._check_width(features)
        if not len(features):
            return np.zeros(0), np.zeros((0, len(self.feature_map)))
        return self._score(contiguous(features, "f8"))

    def moved_most(
        self, features: _Array, errors: _Array, rows: npt.NDArray[np.int32], first: int = 0
    ) -> list[list[int]]:
        """For each of some rows: two autoencoders, and of each the feature that moved most.

        Args:
            features: rows that were scored, and rows before them.
            errors: of each autoencoder, of the rows that were scored.
            rows: numbers of rows that were scored.
            first: number of the first row that was scored.

        Returns:
            The autoencoders with the highest errors, compared with those of training, and of each the feature that is
            farthest from the middle of its range; -1 where there is no second.
        """
        found = np.empty((len(rows), 4), np.int32)
        x, rmse = (
            self._kernel.pointer("double", contiguous(features, "f8")),
            self._kernel.pointer("double", errors),
        )
        given = self._kernel.pointer("int32_t", rows), len(rows), self._kernel.pointer("int32_t", found)
        if self._kernel.lib.kitnet_moved(*self._c_layers(), x, self.width, rmse, first, *given):
            raise ValueError(_UNSOUND)
        moved: list[list[int]] = found.tolist()
        return moved

    def _c_layers(self) -> list[Any]:
        """The layers in C, made once: training changes their numbers in place."""
        layers = self._layers()
        if self._in_c is None or self._in_c[0] is not layers[0] or self._in_c[1] is not layers[1]:
            pinned = [dict(vars(layer)) for layer in layers]  # C points into their arrays
            self._in_c = *layers, [_c_layer(self._kernel, layer) for layer in layers], pinned
        return self._in_c[2]

    def _check_width(self, features: _Array) -> None:
        if features.ndim != 2 or features.shape[1] != self.width:
            raise ValueError(f"features have the shape {features.shape}; give (packets, {self.width})")

    def _layers(self) -> tuple[Layer, Layer]:
        if self.ensemble is None or self.output is None:
            raise ValueError(
                f"KitNET has seen {self.trained} packets and needs {self.training_packets} before it can score: "
                "train it on more packets or lower fm_grace and ad_grace"
            )
        return self.ensemble, self.output

    def _build(self, feature_map: Sequence[Sequence[int]]) -> None:
        self.feature_map = [list(group) for group in feature_map]
        self.ensemble = Layer.fresh(self.feature_map)
        self.output = Layer.fresh([range(len(self.feature_map))])

    def _train(self, features: _Array) -> None:
        kernel = self._kernel
        scratch = self._scratch()
        layers = self._c_layers()
        rows = kernel.pointer("double", features)
        work = kernel.pointer("double", scratch)
        if kernel.lib.kitnet_train(*layers, rows, len(features), self.width, self.learning_rate, work):
            raise ValueError(_UNSOUND)

    def _score(self, features: _Array) -> tuple[_Array, _Array]:
        count = len(features)
        whole = count - count % _LANES
        room = whole if whole == count else whole + _LANES
        errors, scores = np.empty((room, len(self.feature_map))), np.empty(room)
        scratch = self._scratch()
        if whole:
            self._score_lanes(features[:whole], scratch, errors, scores)
        if whole < count:
            last = np.zeros((_LANES, self.width))
            last[: count - whole] = features[whole:]
            self._score_lanes(last, scratch, errors[whole:], scores[whole:])
        return scores[:count], errors[:count]

    def _score_lanes(self, features: _Array, scratch: _Array, errors: _Array, scores: _Array) -> None:
        """Rows of which there are a multiple of `_LANES`."""
        kernel = self._kernel
        rows, work, rmse, out = (
            kernel.pointer("double", array) for array in (features, scratch, errors, scores)
        )
        given = rows, len(features), self.width, self.clip, work, rmse, out
        if kernel.lib.kitnet_score(*self._c_layers(), *given):
            raise ValueError(_UNSOUND)

    def _scratch(self) -> _Array:
        units = sum(sum(layer.weights.shape) for layer in self._layers())
        return np.empty(_LANES * units)


def _c_layer(kernel: Kernel, layer: Layer) -> Any:
    count, visible, hidden = layer.weights.shape
    struct = kernel.ffi.new("Layer *")
    struct.count, struct.visible, struct.hidden = count, visible, hidden
    struct.visible_of = kernel.pointer("int32_t", layer.visible_of)
    struct.hidden_of = kernel.pointer("int32_t", layer.hidden_of)
    struct.input = kernel.pointer("int32_t", layer.index)
    for name in ("weights", "hidden_bias", "visible_bias", "low", "high"):
        setattr(struct, name, kernel.pointer("double", getattr(layer, name)))
    return struct
