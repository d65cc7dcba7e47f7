"""KitNET in numpy: the kernel's steps, for all autoencoders of a layer at once."""

import numpy as np

from apps.kitsune.kitnet import KitNet, Layer

_BLOCK = 1024


class PythonKitNet(KitNet):
    """`KitNet` without its kernel."""

    def _train(self, features):
        ensemble, output = self._layers()
        for row in features:
            train_one(output, train_one(ensemble, row, self.learning_rate), self.learning_rate)

    def _score(self, features):
        ensemble, output = self._layers()
        blocks = [
            errors_of(ensemble, features[start : start + _BLOCK], self.clip)
            for start in range(0, len(features), _BLOCK)
        ]
        errors = np.concatenate(blocks)
        return errors_of(output, errors, self.clip)[:, 0], errors


def masks(layer: Layer):
    """1 where a unit exists: visible ones, hidden ones."""
    _, visible, hidden = layer.weights.shape
    return (
        (np.arange(visible) < layer.visible_of[:, None]).astype(float),
        (np.arange(hidden) < layer.hidden_of[:, None]).astype(float),
    )


def train_one(layer, row, rate):
    """One step of gradient descent for all autoencoders; returns their RMSE before the step."""
    visible_mask, hidden_mask = masks(layer)
    values = row[layer.index]
    layer.low = np.where(values < layer.low, values, layer.low)
    layer.high = np.where(values > layer.high, values, layer.high)
    x = (values - layer.low) / (layer.high - layer.low + 1e-16) * visible_mask
    y = _sigmoid(np.matmul(x[:, None], layer.weights)[:, 0] + layer.hidden_bias) * hidden_mask
    z = _sigmoid(np.matmul(layer.weights, y[..., None])[..., 0] + layer.visible_bias)
    e = (x - z) * visible_mask
    gradient = np.matmul(e[:, None], layer.weights)[:, 0] * y * (1 - y)
    layer.weights += rate * (x[..., None] * gradient[:, None] + e[..., None] * y[:, None])
    layer.hidden_bias += rate * gradient
    layer.visible_bias += rate * e
    return np.asarray(np.sqrt((e**2).sum(axis=1) / layer.visible_of))


def errors_of(layer, rows, clip):
    """RMSE of each autoencoder for rows of inputs, shape (rows, autoencoders)."""
    visible_mask, _ = masks(layer)
    values = rows[:, layer.index].transpose(1, 0, 2)
    x = (values - layer.low[:, None]) / (layer.high - layer.low + 1e-16)[:, None]
    if clip:
        x = np.clip(x, -clip, clip)
    x = np.where(visible_mask[:, None] > 0, x, 0.0)
    y = _sigmoid(np.matmul(x, layer.weights) + layer.hidden_bias[:, None])
    z = _sigmoid(np.matmul(y, layer.weights.transpose(0, 2, 1)) + layer.visible_bias[:, None])
    e = (x - z) * visible_mask[:, None]
    return np.asarray(np.sqrt((e**2).sum(axis=2) / layer.visible_of[:, None]).T)


def _sigmoid(x):
    with np.errstate(over="ignore"):
        return np.asarray(1.0 / (1.0 + np.exp(-x)))
