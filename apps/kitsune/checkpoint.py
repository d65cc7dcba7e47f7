"""A detector as bytes, and back: whatever packets follow, scores, alerts and evidence are those it would have given.

    Detector ──► kernel: statistics and trackers │ network as in a model file │ what Python keeps ──► packed arrays

At any point of a stream: while the feature map is learnt, while the autoencoders train, afterwards.  Blocks in force are
no part of it: the firewall says which there are.  A checkpoint belongs to the settings under which it was made, and to
this version.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from apps.kitsune.afterimage import WIDTH
from apps.kitsune.behaviour.baseline import Baseline, BlockMaxima
from apps.kitsune.detector import Detector, DetectorSettings
from apps.kitsune.detector_parts import parts
from apps.kitsune.drift import Drift, DriftReading
from apps.kitsune.kernel import Kernel
from apps.kitsune.kernel_rows import SwitchNumbers
from apps.kitsune.kitnet import KitNet
from apps.kitsune.model_file import network_arrays, network_header, network_in
from apps.kitsune.packed_arrays import CheckpointError, pack, unpack
from apps.kitsune.plain_values import SubjectName, built, plain, read, restore
from apps.kitsune.reasons import Explanation
from apps.kitsune.threshold import Benign

VERSION: Final = 1
MARK: Final = b"SDNKITCK"
_DEPENDS_ON: Final = (
    *("fm_grace", "ad_grace", "max_ae", "mode", "max_streams", "max_links", "horizon", "clip"),
    "calibration_packets",
)
"""Settings that a checkpoint belongs to."""
_TRACKERS: Final = ("afterimage", "senders", "behaviour", "victims")
_MAPPER: Final = ("_sum", "_residual", "_squares", "_products")
_MOST_SWITCHES: Final = 65_535
_ROLES: Final = ("dns", "dhcp", "multicast")
_READING: Final = tuple[bool, float, float, float, int]
_WRONG: Final = (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError, MemoryError)


def dump(detector: Detector, beside: Any = None) -> bytes:
    """A checkpoint of a detector, between two batches.

    Args:
        detector: stays as it is; its evidence was taken.
        beside: what its user keeps with it, fit for JSON.

    Returns:
        At most as long as the settings' limits of streams and links allow.
    """
    network = detector.model
    arrays: dict[str, npt.NDArray[Any]] = {name: _dumped(detector, name) for name in _TRACKERS}
    arrays |= network_arrays(network)
    if not network.feature_map:
        arrays |= {f"mapper{name}": getattr(network._mapper, name) for name in _MAPPER}
    rows = {"tail": detector._tail, "sample": detector._sample, "scores": detector.calibration._scores}
    for name, batches in rows.items():
        if batches:
            arrays[name] = np.concatenate(list(batches))
    header = {
        "settings": _settings(detector.settings),
        "network": network_header(network),
        "trained": network.trained,
        "mapped": network._mapper.packets,
        "lengths": {name: [len(each) for each in batches] for name, batches in rows.items()},
        "values": read(parts(detector)),
        "maxima": [_learnt(each) for each in _baselines(detector)],
        "kept": [[batch, plain(found)] for batch, found in detector.senders._kept.items()],
        "benign": None if detector.calibration.benign is None else detector.calibration.benign.to_state(),
        "drift": None if detector.drift is None else _drift_values(detector.drift),
        "trained_for": detector.trained_for,
        "beside": beside,
    }
    return pack(MARK, VERSION, header, arrays)


def load(data: bytes, settings: DetectorSettings, kernel: Kernel) -> tuple[Detector, Any]:
    """The detector of a checkpoint.

    Args:
        data: what `dump` returned, from anywhere.
        settings: of the detector; those of training must be those under which it was made.
        kernel: the C kernel.

    Returns:
        The detector, and what was kept beside it, unchecked.

    Raises:
        CheckpointError: the bytes are none, or belong to other settings or another version.
    """
    header, arrays = unpack(data, MARK, VERSION)
    try:
        _check_settings(header["settings"], settings)
        detector = Detector(settings, kernel=kernel)
        detector.model = _network(header, arrays, detector)
        restore(parts(detector), header["values"])
        _restore_learnt(detector, header)
        _restore_rows(detector, header, arrays)
        switches = _renumber(detector)
        detector.behaviour.check_names()
        _restore_kernel(detector, arrays, switches, kernel)
        _restore_kept(detector, header["kept"])
    except CheckpointError:
        raise
    except _WRONG as error:
        raise CheckpointError(f"a damaged checkpoint: {error}") from error
    detector.threshold = detector._threshold()
    return detector, header.get("beside")


def _settings(settings: DetectorSettings) -> dict[str, Any]:
    return {name: getattr(settings, name) for name in _DEPENDS_ON}


def _check_settings(found: dict[str, Any], settings: DetectorSettings) -> None:
    for name, value in _settings(settings).items():
        if found[name] != value:
            raise CheckpointError(f"the checkpoint was made with {name}={found[name]}, not {value}")


# ---- the kernel


def _handles(detector: Detector) -> dict[str, tuple[Any, Any]]:
    """By tracker its library and its state in C."""
    engine = detector.afterimage._engine
    found = {"afterimage": (engine._kernel.lib, engine._state)}
    for name in _TRACKERS[1:]:
        tracker = getattr(detector, name)
        found[name] = (tracker._kernel.lib, tracker._state)
    return found


def _dumped(detector: Detector, name: str) -> npt.NDArray[np.uint8]:
    lib, state = _handles(detector)[name]
    write = getattr(lib, f"{name}_dump")
    kernel = detector._kernel
    size = write(state, kernel.ffi.NULL, 0)
    if size < 0:
        raise MemoryError(f"{name} cannot be saved: it failed before")
    found = np.empty(size, np.uint8)
    write(state, kernel.pointer("uint8_t", found), size)
    return found


def _restore_kernel(
    detector: Detector, arrays: dict[str, npt.NDArray[Any]], switches: int, kernel: Kernel
) -> None:
    for name, (lib, state) in _handles(detector).items():
        data = arrays[name]
        if data.dtype != np.uint8 or data.ndim != 1:
            raise ValueError(f"{name} is not a row of bytes")
        more = (switches,) if name in ("senders", "behaviour") else ()
        failed = getattr(lib, f"{name}_load")(state, kernel.pointer("uint8_t", data), len(data), *more)
        if failed == -1:
            raise MemoryError(f"no memory for {name}")
        if failed:
            raise ValueError(f"{name}: its numbers contradict each other")


def _renumber(detector: Detector) -> int:
    """Make the numbers of switches those of the checkpoint; returns how many both trackers know."""
    known = []
    for numbers in (detector.senders._switches, detector.behaviour._switches):
        _check_names(numbers)
        numbers._numbers = {name: number for number, name in enumerate(numbers.names)}
        numbers._applied = (-1, -1)  # blocks are handed over anew
        known.append(len(numbers.names))
    return min(known)


def _check_names(numbers: SwitchNumbers) -> None:
    if len(set(numbers.names)) != len(numbers.names) or len(numbers.names) > _MOST_SWITCHES:
        raise ValueError("a switch is named twice")


# ---- the network


def _network(header: dict[str, Any], arrays: dict[str, npt.NDArray[Any]], detector: Detector) -> KitNet:
    settings, described = detector.settings, header["network"]
    if described["feature_map"]:
        network = network_in(described, arrays, settings.scale_limit, detector._kernel)
    else:
        network = detector.model
        for name in _MAPPER:
            array, here = arrays[f"mapper{name}"], getattr(network._mapper, name)
            if array.shape != here.shape or array.dtype != here.dtype:
                raise ValueError(f"the feature map has {name} of shape {array.shape}")
            setattr(network._mapper, name, array)
        network._mapper.packets = built(header["mapped"], int)
        if not 0 <= network._mapper.packets <= network.fm_grace:
            raise ValueError(f"the feature map has seen {network._mapper.packets} packets")
    network.trained = built(header["trained"], int)
    if not 0 <= network.trained <= network.training_packets:
        raise ValueError(f"trained on {network.trained} of {network.training_packets} packets")
    if not network.feature_map and network.trained != network._mapper.packets:
        raise ValueError("the feature map has seen another number of packets than the network")
    return network


# ---- what Python keeps


def _baselines(detector: Detector) -> Iterator[Baseline]:
    for counter in detector.behaviour._counters.values():
        yield counter.baseline


def _learnt(baseline: Baseline) -> list[Any]:
    """The highest counts of blocks, by subject and by kind, while training lasts."""
    tables = (baseline._learning, baseline._kinds)
    return [[[plain(name), plain(maxima.blocks)] for name, maxima in table.items()] for table in tables]


def _restore_learnt(detector: Detector, header: dict[str, Any]) -> None:
    baselines = list(_baselines(detector))
    for baseline, (learning, kinds) in zip(baselines, header["maxima"], strict=True):
        baseline._learning, baseline._kinds = (_maxima(each, baseline._windows) for each in (learning, kinds))
        for counts in (*baseline.highest.values(), *baseline.shared.values()):
            _check_counts(counts, baseline._windows)
    benign = header["benign"]
    detector.calibration.benign = None if benign is None else Benign(**_benign(benign))
    detector.drift = None if header["drift"] is None else _drift(header["drift"])
    detector.trained_for = dict(header["trained_for"])
    roles = detector.senders.roles
    if not set(roles._serves.values()) <= set(_ROLES):
        raise ValueError("unknown roles")
    full = [mac for mac in roles._behind if roles.is_full(mac)]
    detector.senders._full = np.array(full, dtype=np.uint64)
    detector.accused._sorted = None
    if detector._knows_behaviour and not (
        detector.behaviour.seconds > 0 and detector.behaviour.usual_score > 0
    ):
        raise ValueError("training took no time, or has no usual score")


def _maxima(pairs: Any, windows: int) -> dict[Any, BlockMaxima]:
    blocks = built(pairs, dict[SubjectName, dict[int, list[float]]])
    for each in blocks.values():
        for counts in each.values():
            _check_counts(counts, windows)
    return {name: BlockMaxima(each) for name, each in blocks.items()}


def _check_counts(counts: Sequence[float], windows: int) -> None:
    if len(counts) != windows:
        raise ValueError(f"{len(counts)} counts for {windows} windows")


def _benign(state: dict[str, Any]) -> dict[str, Any]:
    kinds = {"packets": int, "log_mean": float, "log_spread": float, "packets_per_hour": float}
    found = {name: built(state[name], kind) for name, kind in kinds.items()}
    if not (found["packets_per_hour"] > 0 and np.isfinite([*found.values()]).all()):
        raise ValueError("benign scores without a distribution")
    return found


def _drift_values(drift: Drift) -> list[Any]:
    reading = drift.reading
    values = None
    if reading is not None:
        values = [reading.drifted, reading.share, reading.least, reading.limit, reading.blocks]
    return [drift.threshold, drift.limit, plain(drift._blocks), values]


def _drift(values: Any) -> Drift:
    threshold, limit, blocks, reading = values
    found = Drift(built(threshold, float), built(limit, float))
    found._blocks.update(built(blocks, dict[int, list[int]]))
    if any(len(counts) != 2 for counts in found._blocks.values()):
        raise ValueError("a half hour of drift does not have two counts")
    found.reading = None if reading is None else DriftReading(*built(reading, _READING))
    return found


def _restore_rows(detector: Detector, header: dict[str, Any], arrays: dict[str, npt.NDArray[Any]]) -> None:
    for name, width in (("tail", (WIDTH,)), ("sample", (WIDTH,)), ("scores", ())):
        lengths = built(header["lengths"][name], list[int])
        rows = arrays.get(name, np.zeros((0, *width)))
        if rows.dtype != np.float64 or rows.shape[1:] != width or any(length < 0 for length in lengths):
            raise ValueError(f"{name} has shape {rows.shape}")
        if sum(lengths) != len(rows):
            raise ValueError(f"{name} has {len(rows)} rows, not {sum(lengths)}")
        batches = np.split(rows, np.cumsum(lengths)[:-1]) if lengths else []
        if name == "scores":
            detector.calibration._scores = batches
        else:
            (detector._tail if name == "tail" else detector._sample).extend(batches)
    calibration = detector.calibration
    if not 0 <= calibration._count <= calibration._wanted or (
        calibration._scores and sum(map(len, calibration._scores)) != calibration._count
    ):
        raise ValueError(f"{calibration._count} of {calibration._wanted} scores of calibration")


def _restore_kept(detector: Detector, kept: Any) -> None:
    """What explains the peaks of the open second: of every place that the kernel names."""
    kind = tuple[tuple[int, ...], tuple[int, ...]]
    for batch, found in kept:
        explained = [Explanation(*each) for each in built(found, list[kind])]
        if not all(each.features and all(0 <= n < WIDTH for n in each.features) for each in explained):
            raise ValueError("an explanation names features that do not exist")
        detector.senders._kept[built(batch, int)] = explained
    lib, state = _handles(detector)["senders"]
    kernel = detector._kernel
    count = lib.senders_kept(state, kernel.ffi.NULL, 0)
    places = np.zeros((count, 2), np.int32)
    lib.senders_kept(state, kernel.pointer("int32_t", places), count)
    for batch, place in places.tolist():
        if place >= len(detector.senders._kept[batch]):
            raise ValueError("a peak without its explanation")
