"""Checkpoints of Kitsune from an archive: whole ones, and the kernel's states in them, under the sanitizers.

What is loaded must be fit for work: it gets packets, and is dumped again.
"""

import os
import random
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from apps.kitsune.checkpoint import MARK, VERSION, dump, load
from apps.kitsune.detector import Detector, DetectorSettings
from apps.kitsune.kernel import Kernel, load_kernel
from apps.kitsune.packed_arrays import CheckpointError, pack, unpack
from benchmarks.cluster_shards import traffic
from benchmarks.hostile_mutation import mutate_bytes
from benchmarks.hostile_sanitizers import BUILDS, kernel_library
from benchmarks.hostile_target import DecoderTarget
from due import RecordBatch

SANITIZED = True
_TRACKERS = ("afterimage", "behaviour", "senders", "victims")
_SETTINGS = DetectorSettings(
    fm_grace=100,
    ad_grace=200,
    calibration_packets=100,
    threshold=0.05,
    max_streams=12,
    max_links=9,
    horizon=20.0,
)
_STAGES = (1, 2, 6)
"""Batches before the dumps: while the feature map is learnt, in training, afterwards."""
_WORDS = (
    0,
    1,
    2,
    7,
    255,
    65_535,
    (1 << 31) - 1,
    1 << 31,
    (1 << 32) - 1,
    (1 << 63) - 1,
    1 << 63,
    (1 << 64) - 1,
)


@cache
def _kernel() -> Kernel:
    return load_kernel(kernel_library()) if BUILDS in os.environ else load_kernel()


@cache
def _batches() -> list[RecordBatch]:
    return list(traffic("s1", 8))


@cache
def _dumps() -> tuple[bytes, ...]:
    """Made by the kernel without sanitizers: this also runs where no libraries of theirs are loaded."""
    found: list[bytes] = []
    detector = Detector(_SETTINGS)
    for number, batch in enumerate(_batches(), 1):
        detector.process(batch, "s1")
        detector.take_evidence()
        if number in _STAGES:
            found.append(dump(detector, {"packets": number}))
    return tuple(found)


@cache
def _unpacked() -> tuple[tuple[dict[str, Any], dict[str, Any]], ...]:
    return tuple(unpack(data, MARK, VERSION) for data in _dumps())


def _whole(data: bytes) -> None:
    detector, _ = load(data, _SETTINGS, _kernel())
    with np.errstate(all="ignore"):
        for batch in _batches()[-2:]:
            detector.process(batch, "s1")
            detector.take_evidence()
    load(dump(detector), _SETTINGS, _kernel())


def _state(data: bytes) -> None:
    """The first byte says of which dump and which tracker, the others are its state."""
    if not data:
        return
    header, arrays = _unpacked()[data[0] // len(_TRACKERS) % len(_STAGES)]
    name = _TRACKERS[data[0] % len(_TRACKERS)]
    _whole(pack(MARK, VERSION, header, {**arrays, name: np.frombuffer(data[1:], np.uint8)}))


def _states() -> tuple[bytes, ...]:
    return tuple(
        bytes([stage * len(_TRACKERS) + number]) + arrays[name].tobytes()
        for stage, (_, arrays) in enumerate(_unpacked())
        for number, name in enumerate(_TRACKERS)
    )


def _words(chance: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Most states keep their length and get a few numbers that are indexes out of range, or others' indexes."""
    if chance.random() < 0.2:
        return mutate_bytes(chance, seeds)
    data = bytearray(chance.choice(seeds))
    for _ in range(chance.randint(1, 3)):
        width = chance.choice((1, 4, 8))
        at = chance.randrange(1, max(2, len(data) - width))
        word = chance.choice(_WORDS) if chance.random() < 0.6 else chance.randrange(32)
        data[at : at + width] = (word & (1 << 8 * width) - 1).to_bytes(width, "little")
    return bytes(data)


TARGETS = (
    DecoderTarget("native kitsune checkpoint", _whole, (CheckpointError,), _dumps()),
    DecoderTarget("native kitsune states", _state, (CheckpointError,), _states(), _words),
)
