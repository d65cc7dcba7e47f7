"""The loop as `sdnator replay` runs it: packets a second, CPU and memory of each process, and whether scores are right.

    python -m benchmarks.replay --json FILE

`default_pps` is `sdnator replay CAPTURE --no-mitigate` with no other option, first frame to last score, training
included; `blocking_pps` the same with blocking, and with all passes that it takes; `blocking_pass_pps` its last pass
alone; `reproducible_pps` with blocking and `--reproducible`; `packet_in_pps` with packet-ins.
`in_flight` is how many packets were when each block took effect, `passed_in_flight` those of blocked senders;
`blocking_passes` says how often the capture was replayed for `blocking_pps`, the dry run included.
`kept_pps` is the default with `--keep`, which archives packets and scores, too: `archived_bytes_per_packet`.
`detector_vs_kernel` is in batches of 1,024 packets, `detector_vs_kernel_by_batch` in those of several sizes up to the
largest of the loop; `batch_packets` is how many packets the batches of `kept` had on average.
`best_pps` is the best round.  Rounds take turns; figures are medians of `rounds`, which are fewer than asked for
(five) if all parts together would take more than ten minutes (`kept`, reproducible and packet-ins: of the first alone).
`rss_mb` is the most memory of each process.  `--long` adds one replay of a capture of 764,137 packets with the same
figures, `rss_mb` among them, as `long`; that takes longer.
`--only PART ...` measures some parts: loop, detector, pipeline (`benchmarks.switch_pipeline`: `pipeline_pps`,
`pipeline_full_pps`), live (`benchmarks.replay_live`: `live_pps_lossless`, `live_vs_bmv2`; root).
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from apps.kitsune.afterimage import AfterImage
from apps.kitsune.detector import Detector
from apps.kitsune.kernel import load_kernel
from apps.kitsune.service import Settings
from benchmarks.measure import arguments, machine, table, write_json
from benchmarks.replay_live import live
from benchmarks.replay_processes import ProcessMeter
from benchmarks.switch_pipeline import figures_of
from due.backends import open_archive
from sdnator.capture.packet_sources import Batch, CaptureSource
from sdnator.datasets.mirai_like import MiraiLikeOptions, make
from sdnator.replay import run
from sdnator.replay.loop import PassResult, ReplayOptions
from sdnator.replay.packet_accounting import PacketState

PACKETS = 165_118
LONG_PACKETS = 764_137
"""Of the published Mirai capture."""
BENIGN_SHARE = 0.45
PACKETS_A_SECOND = 28
LARGER = (2_048, 4_096, 8_192)
"""Packets of larger batches; the last is four full lists of digests, the most that the controller hands over at once."""
ROUNDS = 5
LONGEST_S = 600.0
"""All parts: no round of the loop, which comes last, begins that is likely to end later than that."""
ONCE = ("kept", "reproducible", "packet_in")
"""Ways that are measured in the first round alone."""
_SCORES = "network.anomaly.kitsune.score"
PARTS = ("loop", "detector", "pipeline", "live")
PIPELINE_S = 1.0
"""Traffic of each round."""


def capture_of(folder: Path, packets: int) -> Path:
    """A home network with an infected camera, of so many packets."""
    path = folder / f"{packets}.pcap"
    benign_seconds = BENIGN_SHARE * packets / PACKETS_A_SECOND
    options = MiraiLikeOptions(
        seed=7, benign_seconds=benign_seconds, attack_seconds=benign_seconds, max_packets=packets
    )
    make(options, path)
    return path


def one_round(
    capture: Path, options: ReplayOptions, *, mitigate: bool, kept: bool = False
) -> tuple[dict[str, Any], PassResult]:
    """Figures of one replay, and its result; `kept`: with `--keep`."""
    surveyed, _ = run.prepare(capture, None, options)
    with tempfile.TemporaryDirectory(prefix="sdnator-bench-") as folder, ProcessMeter() as meter:
        outcome = run.run(
            surveyed,
            None,
            replace(options, keep=Path(folder) if kept else None),
            mitigate=mitigate,
            both=False,
            progress=lambda _: meter.look,
        )
        archived = sum(each.stat().st_size for each in Path(folder).glob("*/archive.db*"))
        scored = batch_sizes(Path(folder)) if kept else []
    figures, packets = run.figures(outcome), surveyed.packets
    # a dry run that goes first is part of what blocking costs, and so is a pass that was made again
    seconds = sum(each.seconds for each in outcome.passes)
    return {
        "pps": round(packets / seconds, 1),
        "last_pass_pps": figures["packets_per_second"],
        "passes": len(outcome.passes),
        "in_flight": [block["in_flight"] for block in figures["blocks"]],
        "passed_in_flight": figures["passed_in_flight"],
        "lost": figures["packets_lost"],
        "cpu_us_per_packet": {name: round(s / packets * 1e6, 2) for name, s in meter.loop_cpu_s().items()},
        "start_cpu_s": round(sum(meter.start_cpu_s().values()), 2),
        "rss_mb": meter.peak_mb(),
        "archived_bytes_per_packet": round(archived / packets, 1),
        "batch_packets": round(statistics.mean(scored), 1) if scored else 0.0,
    }, outcome.reported


def batch_sizes(folder: Path) -> list[int]:
    """Packets of each batch that was scored, from the archives that `--keep` has left."""
    found = []
    for path in folder.glob("*/archive.db"):
        driver = open_archive(f"sqlite://{path}")
        try:
            found += [len(item.value["score"]) for item in driver.find({"dataKey": _SCORES})]
        finally:
            driver.close()
    return found


def batches_of(capture: Path) -> list[Batch]:
    """The capture's packets by the parser of frames, which the loop does not use by default."""
    return list(CaptureSource(capture))


def joined(batches: Sequence[Batch], packets: int) -> list[Batch]:
    """The same packets in batches of so many."""
    columns = {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}
    firsts = range(0, len(columns["length"]), packets)
    return [{name: column[at : at + packets] for name, column in columns.items()} for at in firsts]


def settings(options: ReplayOptions) -> Settings:
    return Settings(fm_grace=options.fm_grace, ad_grace=options.ad_grace, mode="reference")


def scores_equal(batches: Sequence[Batch], result: PassResult, options: ReplayOptions) -> float:
    """Largest relative difference of the loop's scores to those of one detector over the capture's frames."""
    detector = Detector(settings(options), kernel=load_kernel())
    scores = np.concatenate([detector.process(dict(batch), "s1")[0].scores for batch in batches])
    scored = result.flight.state == PacketState.SCORED
    wanted: npt.NDArray[np.float64] = scores[scored]
    return float(np.max(np.abs(result.flight.score[scored] - wanted) / np.maximum(np.abs(wanted), 1e-300)))


def detector_vs_kernel(batches: Sequence[Batch], options: ReplayOptions, rounds: int) -> dict[str, float]:
    """CPU of features and scores alone, by that of `Detector.process` over the same packets after training.

    They take turns at each batch, so that a busy machine slows both.
    """
    lengths = [len(batch["length"]) for batch in batches]
    first = sum(np.cumsum(lengths) <= options.training_packets) + 1
    found: dict[str, list[float]] = {"kernel": [], "detector": [], "ratio": []}
    for _ in range(rounds):
        detector = Detector(settings(options), kernel=load_kernel())
        afterimage = AfterImage("reference", kernel=load_kernel())
        for batch in batches[:first]:
            detector.process(dict(batch), "s1")
            afterimage.update(batch)
        kernel = whole = 0.0
        for batch in batches[first:]:
            began = time.process_time()
            detector.model.score(afterimage.update(batch))
            between = time.process_time()
            detector.process(dict(batch), "s1")
            detector.take_evidence()
            kernel, whole = kernel + between - began, whole + time.process_time() - between
        for name, value in (("kernel", kernel), ("detector", whole)):
            found[name].append(value / sum(lengths[first:]) * 1e6)
        found["ratio"].append(kernel / whole)
    kernel_us, detector_us, ratio = (statistics.median(values) for values in found.values())
    return {
        "kernel_us_per_packet": round(kernel_us, 2),
        "detector_us_per_packet": round(detector_us, 2),
        "detector_vs_kernel": round(ratio, 3),
    }


def measured(capture: Path, rounds: int, deadline: float) -> dict[str, Any]:
    """Ways of replaying in turn; after the first, no round is begun that is likely to end after the deadline."""
    options = ReplayOptions()
    ways = {
        "default": (options, False),
        "blocking": (options, True),
        "reproducible": (replace(options, reproducible=True), True),
        "kept": (options, False),
        "packet_in": (replace(options, telemetry="packet-in"), False),
    }
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in ways}
    result = None
    longest = 0.0
    for number in range(rounds):
        since = time.monotonic()
        if number and since + longest > deadline:
            break
        for name, (chosen, mitigate) in ways.items():
            if number and name in ONCE:
                continue
            figures, passed = one_round(capture, chosen, mitigate=mitigate, kept=name == "kept")
            found[name].append(figures)
            result = passed if name == "default" else result
        longest = max(longest if number > 1 else 0.0, time.monotonic() - since)
    assert result is not None
    default, blocking = found["default"], found["blocking"]
    return {
        "rounds": len(default),
        **{f"{name}_pps": statistics.median(each["pps"] for each in rows) for name, rows in found.items()},
        "default_pps_rounds": [each["pps"] for each in default],
        "blocking_pps_rounds": [each["pps"] for each in blocking],
        "blocking_pass_pps": statistics.median(each["last_pass_pps"] for each in blocking),
        "blocking_passes": [each["passes"] for each in blocking],
        "in_flight": [each["in_flight"] for each in blocking],
        "passed_in_flight": [each["passed_in_flight"] for each in blocking],
        "reproducible_passed_in_flight": found["reproducible"][0]["passed_in_flight"],
        "best_pps": max(each["pps"] for rows in found.values() for each in rows),
        "lost": sum(each["lost"] for rows in found.values() for each in rows),
        "cpu_us_per_packet": _medians([each["cpu_us_per_packet"] for each in default]),
        "start_cpu_s": statistics.median(each["start_cpu_s"] for each in default),
        "rss_mb": _medians([each["rss_mb"] for each in default]),
        "archived_bytes_per_packet": found["kept"][0]["archived_bytes_per_packet"],
        "batch_packets": found["kept"][0]["batch_packets"],
        "scores_equal": scores_equal(batches_of(capture), result, options),
    }


def detector_figures(capture: Path, rounds: int) -> dict[str, Any]:
    """`detector_vs_kernel` in batches of several sizes."""
    batches, options = batches_of(capture), ReplayOptions()
    found = detector_vs_kernel(batches, options, rounds)
    ratios = {len(batches[0]["length"]): found["detector_vs_kernel"]}
    for packets in LARGER:
        ratios[packets] = detector_vs_kernel(joined(batches, packets), options, rounds)["detector_vs_kernel"]
    return found | {"detector_vs_kernel_by_batch": {f"{size}": ratio for size, ratio in ratios.items()}}


def _medians(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    names = sorted({name for row in rows for name in row})
    found = {name: statistics.median(row.get(name, 0.0) for row in rows) for name in names}
    return found | {"all": round(sum(found.values()), 2)}


def main() -> int:
    parser = arguments("replay", __doc__, rounds=ROUNDS)
    parser.add_argument("--long", action="store_true", help=f"also a capture of {LONG_PACKETS:,} packets")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts to measure")
    chosen = parser.parse_args()
    deadline = time.monotonic() + LONGEST_S
    about, figures = machine(), dict[str, Any]()
    with tempfile.TemporaryDirectory(prefix="sdnator-bench-") as folder:
        if not {"loop", "detector"}.isdisjoint(chosen.only):
            capture = capture_of(Path(folder), max(60_000, int(PACKETS * chosen.scale)))
        if "detector" in chosen.only:
            figures |= detector_figures(capture, chosen.rounds)
        if "pipeline" in chosen.only:
            figures |= figures_of(PIPELINE_S * chosen.scale, chosen.rounds)
        if "live" in chosen.only:
            figures |= live(Path(folder, "live"), chosen.scale)
        if "loop" in chosen.only:
            figures |= measured(capture, chosen.rounds, deadline)
        if chosen.long:
            long, _ = one_round(capture_of(Path(folder), LONG_PACKETS), ReplayOptions(), mitigate=False)
            figures |= {"long": long}
    table(("figure", "value"), [each for each in figures.items() if each[0] != "live_steps"])
    write_json(chosen.json, {"machine": about, **figures})
    return 0


if __name__ == "__main__":
    sys.exit(main())
