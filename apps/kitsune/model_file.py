"""A trained model in a file: one .npz with arrays and a JSON header, versioned, without pickle.

    ModelFileError
    ├── NotAModelError      foreign, damaged or truncated
    └── WrongVersionError   written by a version whose files this one does not read

AfterImage's state is not part of it: the statistics of a capture start empty, as they did in training.
"""

import io
import json
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from apps.kitsune.afterimage import WIDTH
from apps.kitsune.kernel import LAMBDAS, Kernel
from apps.kitsune.kitnet import KitNet, Layer

FORMAT: Final = "sdnator-kitsune-model"
VERSION: Final = 1
_ZIP: Final = b"PK"
"""With which a file of numpy's `savez` begins."""
_ARRAYS: Final = ("weights", "hidden_bias", "visible_bias", "low", "high")


class ModelFileError(ValueError):
    """A model cannot be saved or loaded; the text says which file, what and what to do."""


class NotAModelError(ModelFileError):
    """The file is foreign, damaged or truncated."""


class WrongVersionError(ModelFileError):
    """The file's version is not read by this program."""


@dataclass(frozen=True, slots=True)
class Model:
    """The content of a model file."""

    network: KitNet
    notes: dict[str, Any]
    """Beside the network: senders, roles, benign scores, time of training (`trained_at_us`)."""


def save_model(path: Path, network: KitNet, notes: dict[str, Any]) -> None:
    """Writes a trained network and plain `notes`; the file appears whole or not at all, readable by its owner only.

    Raises `ModelFileError` when the network is untrained or the file cannot be written.
    """
    if network.ensemble is None or network.output is None or not network.is_trained:
        raise ModelFileError(
            f"{path}: the model has seen {network.trained} of {network.training_packets} training packets; "
            "nothing was saved. Train on a longer capture or lower fm_grace and ad_grace"
        )
    header = {"format": FORMAT, "version": VERSION, **network_header(network), "notes": notes}
    arrays: dict[str, npt.NDArray[Any]] = {
        "header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8),
        **network_arrays(network),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    partial = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        # it names the hosts of a network, and what they do
        partial.unlink(missing_ok=True)
        descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(buffer.getvalue())
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise ModelFileError(
            f"{path}: the model cannot be written ({error.strerror}); name another file"
        ) from error


_DAMAGE = (
    ValueError,
    EOFError,
    KeyError,
    AttributeError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    RuntimeError,
    MemoryError,
    OverflowError,
)
"""Errors of numpy's reader on damaged files; it parses array headers as Python literals."""


def load_model(path: Path, *, clip: float = 0.0, kernel: Kernel | None = None) -> Model:
    """Reads a model; raises `ModelFileError` that names the file and what is wrong with it."""
    try:
        _check_beginning(path)
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise ModelFileError(f"{path}: no such model; write one with --save-model") from None
    except OSError as error:
        raise ModelFileError(
            f"{path}: cannot be read ({error.strerror or error}); use a file from --save-model"
        ) from None
    except _DAMAGE as error:
        raise NotAModelError(
            f"{path}: an incomplete Kitsune model ({error}); train again and save the result"
        ) from error
    header = _header(path, arrays)
    try:
        network = network_in(header, arrays, clip, kernel)
        return Model(network, dict(header["notes"]))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise NotAModelError(
            f"{path}: damaged Kitsune model ({error}); train again and save the result"
        ) from error


def _check_beginning(path: Path) -> None:
    """Numpy would take anything else for a pickle, and advise to trust it."""
    with path.open("rb") as file:
        begin = file.read(len(_ZIP))
    if not _ZIP.startswith(begin):
        raise NotAModelError(f"{path}: not a Kitsune model; use a file from --save-model")
    if len(begin) < len(_ZIP):
        raise NotAModelError(
            f"{path}: an incomplete Kitsune model ({len(begin)} bytes); train again and save the result"
        )


def _header(path: Path, arrays: dict[str, npt.NDArray[Any]]) -> dict[str, Any]:
    try:
        header = json.loads(bytes(arrays["header"]))
        found, version = header["format"], header["version"]
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise NotAModelError(
            f"{path}: not a Kitsune model (no header); use a file from --save-model"
        ) from error
    if found != FORMAT:
        raise NotAModelError(f"{path}: not a Kitsune model (format {found!r}); use a file from --save-model")
    if version != VERSION:
        raise WrongVersionError(
            f"{path}: model version {version}, this program reads version {VERSION}; train again"
        )
    return dict(header)


def network_header(network: KitNet) -> dict[str, Any]:
    """What a file says of a network beside its numbers, fit for JSON."""
    return {
        "width": network.width,
        "lambdas": list(LAMBDAS),
        "fm_grace": network.fm_grace,
        "ad_grace": network.ad_grace,
        "max_ae": network.max_ae,
        "feature_map": network.feature_map,
    }


def network_arrays(network: KitNet) -> dict[str, npt.NDArray[np.float64]]:
    """The numbers of both layers by name; none before the feature map is learnt."""
    layers = {"ensemble": network.ensemble, "output": network.output}
    return {
        f"{layer_name}_{name}": getattr(layer, name)
        for layer_name, layer in layers.items()
        if layer is not None
        for name in _ARRAYS
    }


def network_in(
    header: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]], clip: float, kernel: Kernel | None
) -> KitNet:
    """The trained network that `network_header` and `network_arrays` describe.

    Args:
        header: of the file.
        arrays: by name.
        clip: limit of scaled inputs, 0 for none.
        kernel: None loads the one that was built.

    Raises:
        KeyError, TypeError, ValueError, IndexError: they describe none.
    """
    if header["lambdas"] != list(LAMBDAS) or header["width"] != WIDTH:
        raise ValueError(f"it has {header['width']} features with time scales {header['lambdas']}, not ours")
    feature_map = header["feature_map"]
    if sorted(feature for group in feature_map for feature in group) != list(range(WIDTH)):
        raise ValueError("the feature map does not hold every feature once")
    network = KitNet(
        WIDTH,
        fm_grace=header["fm_grace"],
        ad_grace=header["ad_grace"],
        max_ae=header["max_ae"],
        feature_map=feature_map,
        clip=clip,
        kernel=kernel,
    )
    network.ensemble = _layer(arrays, "ensemble", feature_map)
    network.output = _layer(arrays, "output", [list(range(len(feature_map)))])
    network.trained = network.training_packets
    return network


def _layer(arrays: Mapping[str, npt.NDArray[Any]], name: str, groups: list[list[int]]) -> Layer:
    expected = Layer.fresh(groups)
    values = {}
    for part in _ARRAYS:
        array = np.array(arrays[f"{name}_{part}"], dtype=np.float64)
        if array.shape != getattr(expected, part).shape:
            raise ValueError(f"{name}_{part} has shape {array.shape}")
        values[part] = array
    return Layer(expected.inputs, **values)
