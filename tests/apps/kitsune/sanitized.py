"""Runs in a process of its own, with the sanitizers' library: random and extreme columns through the C kernel.

LD_PRELOAD=libasan.so python -m tests.apps.kitsune.sanitized LIBRARY SEED ROUNDS
"""

import math
import sys
from pathlib import Path

import numpy as np

from apps.kitsune.afterimage import WIDTH, AfterImage, Mode
from apps.kitsune.behaviour.native import NativeBehaviour
from apps.kitsune.checkpoint import MARK, VERSION, dump, load
from apps.kitsune.detector import Detector, DetectorSettings
from apps.kitsune.kernel import PACKET_FIELDS, ROW_FIELDS, ColumnError, Kernel, load_kernel
from apps.kitsune.kernel_rows import KernelRows, MarkedRoom
from apps.kitsune.kitnet import KitNet, Layer
from apps.kitsune.packed_arrays import CheckpointError, pack, unpack
from apps.kitsune.senders import Senders
from apps.kitsune.victims import VictimRates
from tests.apps.kitsune.random_traffic import traffic

EDGES = (0, 1, -1, 4, 6, 255, 65_535, 65_536, 2**31 - 1, -(2**31), 2**32 - 1, 2**48, 2**63 - 1, -(2**63))
TIMES = (0.0, -1.0, 1e-300, 1e9, -1e18, float(2**63), 1.8e308, math.inf, -math.inf, math.nan)


def column(random: np.random.Generator, kind: str, rows: int) -> np.ndarray:
    """Numbers of few values, so that streams meet, with extremes among them."""
    if kind == "f8":
        steady = np.cumsum(random.exponential(0.1, rows)) * random.choice([1.0, 1000.0, -1.0])
        return np.where(random.random(rows) < 0.1, random.choice(TIMES, rows), steady)
    size = np.dtype(kind).itemsize
    small = random.integers(0, 9, rows)
    wild = np.array([edge & ((1 << 8 * size) - 1) for edge in EDGES], f"u{size}")
    return np.where(random.random(rows) < 0.2, random.choice(wild, rows), small.astype(f"u{size}")).view(kind)


def batch(random: np.random.Generator, rows: int) -> dict[str, np.ndarray]:
    found = {name: column(random, kind, rows) for name, _, kind in PACKET_FIELDS}
    found["time_s"] = found.pop("time")
    found["ip_version"] = random.choice(np.array([0, 4, 6, 7], "u1"), rows)
    return found


def features(kernel: Kernel, random: np.random.Generator, rounds: int) -> None:
    modes: tuple[Mode, ...] = ("reference", "bounded")
    for number in range(rounds):
        limits = {"max_streams": int(random.choice([2, 5, 64])), "max_links": int(random.choice([1, 3, 64]))}
        image = AfterImage(
            modes[number % 2], horizon=float(random.choice([0.1, 3000])), kernel=kernel, **limits
        )
        for _ in range(5):
            found = image.update(batch(random, int(random.integers(0, 300))))
            assert found.shape[1] == WIDTH
        short = batch(random, 50)
        name = random.choice([name for name, _, _ in PACKET_FIELDS if name != "time"])
        for wrong in (short[name][:10], np.repeat(short[name], 2), short[name].reshape(5, 10)):
            try:
                image.update({**short, name: wrong})
            except ColumnError:
                continue
            raise AssertionError(f"{name} of another length was taken")
        entry(kernel, short)


def entry(kernel: Kernel, columns: dict[str, np.ndarray]) -> None:
    """The C function refuses what Python would not hand it."""
    state = kernel.ffi.gc(kernel.lib.afterimage_new(0, 2, 1, 1.0), kernel.lib.afterimage_free)
    struct, out = kernel.ffi.new("Columns *"), np.empty(10 * WIDTH)
    arrays = {name: columns["time_s" if name == "time" else name][:10].copy() for name, _, _ in PACKET_FIELDS}
    for name, kind, _ in PACKET_FIELDS:
        setattr(struct, name, kernel.pointer(f"const {kind}", arrays[name]))
    whole = [10] * len(PACKET_FIELDS)
    for rows, lengths, room in (
        (11, whole, 2000),
        (10, [*whole[:-1], 9], 1000),
        (10, whole, 999),
        (-1, whole, 1000),
    ):
        given = kernel.ffi.new("long[]", lengths)
        assert (
            kernel.lib.afterimage_update(state, struct, given, rows, kernel.pointer("double", out), room)
            == -2
        )
    given = kernel.ffi.new("long[]", whole)
    assert kernel.lib.afterimage_update(state, struct, given, 10, kernel.pointer("double", out), 1000) == 0


def trackers(kernel: Kernel, random: np.random.Generator, rounds: int) -> None:
    """Senders, behaviour, victims, marked SYNs: training, a batch of anything, findings, what a model keeps."""
    for _ in range(rounds):
        senders, rates = Senders(kernel), VictimRates(kernel)
        behaviour = NativeBehaviour(200, kernel)
        left = 200
        for step in range(6):
            rows = int(random.integers(1, 200))
            found = batch(random, rows)
            found |= {name: column(random, kind, rows) for name, _, kind in ROW_FIELDS if name not in found}
            found.pop("time")
            scores = random.choice([0.1, 2.0, math.nan, math.inf], rows)
            trained = min(left, rows)
            left -= trained
            how = {"scores": scores, "trained": trained, "threshold": 1.0, "evidence": lambda chosen: chosen}
            senders.add(found, f"s{step % 2}", **how)
            rates.add(found, trained)
            behaviour.add(found, f"s{step % 2}", scores, trained, lambda: np.full(50, 0.5))
            found["tcp_seq"] = np.where(random.random(rows) < 0.5, found["ip_dst_lo"], 0).astype("u4")
            found["tcp_flags"] = random.choice(np.array([2, 18], "u1"), rows)
            KernelRows(
                kernel, found | {"time_us": random.integers(-(2**63), 2**63 - 1, len(found["length"]))}
            ).marked(trained, MarkedRoom(kernel, int(random.choice([1, 7, 256]))))
        senders.finish()
        rates.to_state(), senders.to_state(), behaviour.to_state()


def network(kernel: Kernel, random: np.random.Generator, rounds: int) -> None:
    for number in range(rounds):
        width = int(random.integers(2, 30))
        net = KitNet(
            width, fm_grace=20, ad_grace=30, max_ae=int(random.integers(1, 9)), clip=number % 2, kernel=kernel
        )
        rows = random.normal(size=(90, width))
        rows[60:][random.random((30, width)) < 0.2] = random.choice(TIMES)
        net.process(rows)
        assert net.ensemble is not None
        broken = Layer.fresh([[0, 1]])
        broken.index[0, 1] = width
        net.ensemble = broken
        for act in (net.learn, net.score):
            try:
                act(rows[:16])
            except ValueError:
                continue
            raise AssertionError("an index out of range was taken")


def checkpoints(kernel: Kernel, random: np.random.Generator, rounds: int) -> None:
    """What is loaded from damaged bytes is refused, or works."""
    options = DetectorSettings(
        fm_grace=30, ad_grace=90, calibration_packets=60, threshold=0.05, max_streams=12, max_links=9
    )
    for _ in range(rounds):
        detector = Detector(options, kernel=kernel)
        for step in range(int(random.integers(1, 6))):
            detector.process(traffic(random, 60, 30.0 * step), f"s{step % 2}")
            detector.take_evidence()
        header, arrays = unpack(dump(detector), MARK, VERSION)
        for _ in range(20):
            name = str(random.choice(["afterimage", "senders", "behaviour", "victims"]))
            raw = arrays[name].copy()
            for _ in range(int(random.integers(0, 4))):
                at, width = int(random.integers(len(raw))), int(random.choice([1, 4, 8]))
                word = (int(random.choice(EDGES)) & (1 << 64) - 1).to_bytes(8, "little")[:width]
                raw[at : at + width] = np.frombuffer(word, np.uint8)[: len(raw) - at]
            try:
                moved, _ = load(pack(MARK, VERSION, header, {**arrays, name: raw}), options, kernel)
            except CheckpointError:
                continue
            moved.process(traffic(random, 60, 200.0), "s1")
            dump(moved)


def main() -> None:
    library, seed, rounds = sys.argv[1:]
    kernel = load_kernel(Path(library))
    random = np.random.default_rng(int(seed))
    with np.errstate(all="ignore"):
        features(kernel, random, int(rounds))
        network(kernel, random, int(rounds))
        trackers(kernel, random, int(rounds))
        checkpoints(kernel, random, int(rounds) // 2)
    print("clean")


if __name__ == "__main__":
    main()
