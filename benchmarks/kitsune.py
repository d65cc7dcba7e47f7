"""How fast Kitsune is, beside the published way of doing it: `python -m benchmarks.kitsune --json FILE`.

Needs the test data (--data, SDNATOR_TEST_DATA).  One core, processor time, medians of rounds in which all
peers take turns.  Ordinary traffic is the 38,363 real packets; the naive version is sdnator/testing/oracles,
line for line as eager as the published code.
"""

import argparse
import functools
import itertools
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from apps.kitsune.afterimage import AfterImage, Mode
from apps.kitsune.detector import Detector, DetectorSettings
from apps.kitsune.kernel import load_kernel
from apps.kitsune.kitnet import KitNet
from apps.packets import PACKET_COLUMNS
from benchmarks import measure
from benchmarks.data_folder import add_data_option, data_file
from sdnator.capture.captures import Capture
from sdnator.capture.packet_sources import BATCH, Batch, CaptureSource, frame_batch
from sdnator.datasets.mirai_like import make_mirai_like
from sdnator.datasets.rebuild import rebuild
from sdnator.detect.run import DetectOptions, detect
from sdnator.testing.oracles.afterimage import NaiveAfterImage
from sdnator.testing.oracles.kitnet import NaiveKitNet
from sdnator.testing.packet_rows import tsv_rows

FM_GRACE, AD_GRACE = 2_000, 10_000
SNAP = 200
HUB_PEERS = 20_000
HUB_ROUND = 200_000
FLAT_PACKETS = 5_000_000
SEEDS = (1, 2, 3)


def main(argv: Sequence[str] | None = None) -> int:
    """Run all, print a table, write the figures."""
    parser = measure.arguments("kitsune", __doc__, rounds=5)
    parser.add_argument(
        "--naive-rounds", type=int, default=1, help="rounds of the naive version (a minute each)"
    )
    add_data_option(parser)
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    chosen = parser.parse_args(argv)
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if chosen.worker:
        print(json.dumps(memory_growth(int(chosen.worker))))
        return 0
    found = figures_of(chosen.data, chosen.rounds, chosen.naive_rounds, chosen.scale)
    figures = {"machine": measure.machine(), "vectors": vectors(), **found}
    rows = [(name, value) for name, value in figures.items() if isinstance(value, int | float)]
    measure.table(("figure", "value"), rows)
    for name in ("seeds", "modes"):
        print(f"\n{name}: {json.dumps(figures[name])}")
    measure.write_json(chosen.json, figures)
    return 0


def figures_of(data: Path, rounds: int, naive_rounds: int, scale: float) -> dict[str, Any]:
    """All figures; a scale below 1 takes fewer packets in the hub, memory and naive parts."""
    batches = whole_batches(data)
    figures: dict[str, Any] = speeds(batches, rounds, data)
    snapped = speeds(snapped_batches(data), rounds, data)
    figures |= {f"snap{SNAP}_{name}": value for name, value in snapped.items()}
    naive = naive_speeds(data, naive_rounds, int(38_363 * min(scale, 1.0)))
    figures |= naive
    for prefix in ("", f"snap{SNAP}_"):
        figures[f"{prefix}ratio_features"] = figures[f"{prefix}features_pps"] / naive["naive_features_pps"]
        figures[f"{prefix}ratio_total"] = figures[f"{prefix}total_pps"] / naive["naive_total_pps"]
    figures |= detector_speeds(batches, rounds)
    figures |= hub_speeds(batches, rounds)
    figures["rss_growth_mb"] = grown(int(FLAT_PACKETS * scale))
    figures["modes"] = compare_modes(batches)
    figures["seeds"] = [look_alike(seed) for seed in SEEDS] if scale >= 1 else []
    return figures


def vectors() -> str:
    """For which vector instructions KitNET's loops in use were compiled."""
    kernel = load_kernel()
    name: bytes = kernel.ffi.string(kernel.lib.kitnet_vectors())
    return name.decode()


def whole_batches(data: Path) -> list[Batch]:
    """The real packets as batches of columns."""
    return list(CaptureSource(data_file(data, "kitsune/mirai_38k.tsv.gz")))


def snapped_batches(data: Path) -> list[Batch]:
    """The same out of frames that were cut at 200 bytes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mirai.pcap"
        rebuild(data_file(data, "kitsune/mirai_38k.tsv.gz"), path)
        return [_cut(batch, start) for start, batch in _frames(path)]


def _frames(path: Path) -> Iterator[tuple[int, tuple[list[bytes], list[int], list[int]]]]:
    start = 0
    with Capture(path) as capture:
        frames = iter(capture)
        while chunk := list(itertools.islice(frames, BATCH)):
            times, lengths, data = (list(column) for column in zip(*chunk, strict=True))
            yield start, (data, lengths, times)
            start += len(chunk)


def _cut(frames: tuple[list[bytes], list[int], list[int]], start: int) -> Batch:
    data, lengths, times = frames
    cut = tuple(frame[:SNAP] for frame in data)
    return frame_batch(cut, tuple(lengths), np.array(times, dtype=np.int64), start)


def timed(work: Callable[[], int]) -> float:
    """Packets per second of processor time."""
    begun = time.process_time()
    packets = work()
    return packets / (time.process_time() - begun)


def features_of(batches: Sequence[Batch], mode: Mode = "reference") -> npt.NDArray[np.float64]:
    """All features, batch by batch."""
    afterimage = AfterImage(mode, kernel=load_kernel())
    return np.concatenate([afterimage.update(batch) for batch in batches])


def speeds(batches: Sequence[Batch], rounds: int, data: Path) -> dict[str, Any]:
    """Features, execute phase, and equality with the reference vectors."""
    packets = sum(len(batch["length"]) for batch in batches)
    features = features_of(batches)
    network = KitNet(fm_grace=FM_GRACE, ad_grace=AD_GRACE, kernel=load_kernel())
    network.learn(features[: network.training_packets])
    first = network.training_packets

    def only_features() -> int:
        features_of(batches)
        return packets

    def only_scores() -> int:
        for start in range(first, packets, BATCH):
            network.score(features[start : start + BATCH])
        return packets - first

    def total() -> int:
        afterimage = AfterImage("reference", kernel=load_kernel())
        for batch in batches:
            network.score(afterimage.update(batch))
        return packets

    peers = {"features_pps": only_features, "execute_pps": only_scores, "total_pps": total}
    figures: dict[str, Any] = measure.interleaved(
        {name: functools.partial(timed, work) for name, work in peers.items()}, rounds
    )
    scores = network.score(features[first:])[0]
    return figures | accuracy(data, features, network.feature_map, scores)


def detector_speeds(batches: Sequence[Batch], rounds: int) -> dict[str, float]:
    """What the app calls (`Detector.process`, with senders, behaviour and evidence) beside features and scores alone.

    Training included on both sides; they take turns at each batch, so that a busy machine slows both.
    """
    ratios, speeds_found = [], []
    for _ in range(rounds):
        settings = DetectorSettings(fm_grace=FM_GRACE, ad_grace=AD_GRACE, mode="reference")
        detector = Detector(settings, kernel=load_kernel())
        afterimage = AfterImage("reference", kernel=load_kernel())
        network = KitNet(fm_grace=FM_GRACE, ad_grace=AD_GRACE, kernel=load_kernel())
        alone = whole = 0.0
        for batch in batches:
            begun = time.process_time()
            network.process(afterimage.update(batch))
            between = time.process_time()
            detector.process(batch, "s1")
            detector.take_evidence()
            alone, whole = alone + between - begun, whole + time.process_time() - between
        ratios.append(alone / whole)
        speeds_found.append(sum(len(batch["length"]) for batch in batches) / whole)
    return {
        "detector_pps": statistics.median(speeds_found),
        "detector_vs_kernel": statistics.median(ratios),
    }


def accuracy(
    data: Path,
    features: npt.NDArray[np.float64],
    feature_map: list[list[int]],
    scores: npt.NDArray[np.float64],
) -> dict[str, Any]:
    """Equality with what the published code computed."""
    wanted = np.load(data_file(data, "kitsune/features_first3000_f64.npz"))["features"]
    published = np.load(data_file(data, "kitsune/scores.npz"))["fm2000_ad10000_m10"][-len(scores) :]
    map_text = data_file(data, "kitsune/feature_map_fm2000_ad10000_m10.json").read_text()
    return {
        "differing_cells": int(np.count_nonzero(features[: len(wanted)] != wanted)),
        "feature_map_equal": feature_map == json.loads(map_text),
        "score_error": float(np.max(np.abs(scores / published - 1))),
    }


def naive_speeds(data: Path, rounds: int, packets: int) -> dict[str, float]:
    """The published way: features eagerly, then one numpy call per step and autoencoder."""
    rows = list(tsv_rows(data_file(data, "kitsune/mirai_38k.tsv.gz"), packets))
    per_feature, per_total = [], []
    for _ in range(rounds):
        naive, network = NaiveAfterImage(), NaiveKitNet(100, 10, packets // 20, packets // 4)
        begun = time.process_time()
        features = [np.array(naive.update(row)) for row in rows]
        feature_s = (time.process_time() - begun) / len(rows)
        training = packets // 20 + packets // 4 + 1
        for row in features[:training]:
            network.process(row)
        begun = time.process_time()
        for row in features[training:]:
            network.process(row)
        execute_s = (time.process_time() - begun) / (len(rows) - training)
        per_feature.append(1 / feature_s)
        per_total.append(1 / (feature_s + execute_s))
    return {
        "naive_features_pps": statistics.median(per_feature),
        "naive_total_pps": statistics.median(per_total),
    }


def hub_batches(packets: int, seed: int, start_us: int) -> list[Batch]:
    """One host and 20,000 peers, revisited at random, in both directions."""
    random = np.random.default_rng(seed)
    peer, outward = random.integers(0, HUB_PEERS, packets), random.random(packets) < 0.5
    columns = {
        name: np.full(packets, -1 if kind[0] == "i" else 0, dtype=kind)
        for name, kind in PACKET_COLUMNS.items()
    }
    hub = {"mac": 0x02FF00000001, "ip": 0xC0A80001, "port": 53}
    far = {"mac": 0x020000000000 + peer, "ip": 0x0A000001 + peer, "port": 1_024 + peer}
    for side, is_hub in (("src", outward), ("dst", ~outward)):
        columns[f"eth_{side}"] = np.where(is_hub, hub["mac"], far["mac"]).astype("u8")
        columns[f"ip_{side}_lo"] = np.where(is_hub, hub["ip"], far["ip"]).astype("u8")
        columns[f"udp_{side[0]}port"] = np.where(is_hub, hub["port"], far["port"]).astype("i4")
    columns["ip_version"][:] = 4
    columns["length"] = random.choice([60, 90, 300, 1514], packets).astype("u4")
    columns["time_us"] = start_us + np.cumsum(random.integers(1, 200, packets))
    return [
        {name: column[start : start + BATCH] for name, column in columns.items()}
        for start in range(0, packets, BATCH)
    ]


def hub_speeds(batches: Sequence[Batch], rounds: int) -> dict[str, float]:
    """Bounded mode on a busy host's traffic, beside ordinary traffic."""
    packets = sum(len(batch["length"]) for batch in batches)
    hub = AfterImage("bounded", kernel=load_kernel())
    clock = [1_600_000_000_000_000]

    def busy(count: int = HUB_ROUND) -> float:
        made = hub_batches(count, clock[0] % 1_000, clock[0])
        clock[0] = int(made[-1]["time_us"][-1])
        return timed(lambda: sum(len(hub.update(batch)) for batch in made))

    def ordinary() -> float:
        return timed(lambda: len(features_of(batches, "bounded")) or packets)

    busy()  # all peers are known from here on
    found = measure.interleaved({"bounded_pps": ordinary, "bounded_hub_pps": busy}, rounds)
    return found | {"hub_ratio": found["bounded_hub_pps"] / found["bounded_pps"]}


def grown(packets: int) -> float:
    """Memory that another process gains between the first fifth and the end, MB."""
    command = [sys.executable, "-m", "benchmarks.kitsune", "--worker", str(packets)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(json.loads(done.stdout))


def memory_growth(packets: int) -> float:
    """Bounded mode on hub traffic: growth of resident memory after the first fifth, MB."""
    afterimage = AfterImage("bounded", kernel=load_kernel())
    clock, first = 1_600_000_000_000_000, 0.0
    steps = max(packets // 100_000, 5)
    for step in range(steps):
        for batch in hub_batches(100_000, step, clock):
            afterimage.update(batch)
            clock = int(batch["time_us"][-1])
        if step == steps // 5:
            first = _resident_mb()
    return _resident_mb() - first


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def compare_modes(batches: Sequence[Batch]) -> dict[str, Any]:
    """Bounded against reference mode on the real packets: cells and scores that differ."""
    rows: Mapping[Mode, Any] = {mode: features_of(batches, mode) for mode in ("reference", "bounded")}
    scores = {}
    for mode, features in rows.items():
        network = KitNet(fm_grace=FM_GRACE, ad_grace=AD_GRACE, kernel=load_kernel())
        scores[mode] = network.process(features)[0][network.training_packets :]
    change = np.abs(scores["bounded"] / scores["reference"] - 1)
    return {
        "differing_cells": float(np.mean(rows["bounded"] != rows["reference"])),
        "score_change_median": float(np.median(change)),
        "score_change_max": float(change.max()),
        "over_1": {mode: int(np.count_nonzero(score >= 1)) for mode, score in scores.items()},
    }


def look_alike(seed: int) -> dict[str, Any]:
    """The generated onset: quality and delay of both modes."""
    with tempfile.TemporaryDirectory() as folder:
        made = make_mirai_like(Path(folder) / "mirai.pcap", seed=seed)
        found: dict[str, Any] = {"seed": seed}
        alerts = {}
        for mode in ("reference", "bounded"):
            options = DetectOptions(
                out=Path(folder) / mode, capture=made.capture, labels=made.labels, mode=mode
            )
            summary = detect(options)
            alerts[mode] = (options.out / "alerts.csv").read_text()
            names = (
                "auc",
                "tpr_at_fpr_0",
                "tpr_at_fpr_0.001",
                "equal_error_rate",
                "first_alert_after_onset_s",
            )
            found[mode] = {name: summary[name] for name in names}
        found["alerts_differ"] = _senders(alerts["reference"]) != _senders(alerts["bounded"])
    return found


def _senders(table: str) -> list[list[str]]:
    """Time, MAC, address and first packet of each alert."""
    return [line.split(",")[:4] for line in table.splitlines()]


if __name__ == "__main__":
    sys.exit(main())
