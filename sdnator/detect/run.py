"""Kitsune alone on a capture or an interface: scores, alerts, a plot and, with labels, its quality.

source ─► Detector ─► scores.csv, scores.parquet, alerts.csv, scores.png, features.npy, summary.json
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from apps.kitsune.afterimage import Mode
from apps.kitsune.detector import SCORED, Detector, DetectorSettings
from apps.kitsune.kernel import load_kernel
from apps.kitsune.model_file import ModelFileError, load_model
from apps.messages import Alert
from sdnator.capture.labels import Labels, read_labels
from sdnator.capture.packet_sources import Batch, CaptureSource
from sdnator.detect.detect_output import OutputFolder
from sdnator.detect.detection_quality import measures
from sdnator.errors import BadInput

Progress = Callable[[int, int], None]
"""Packets so far, alerts so far."""
_YEAR_S = 365.25 * 86_400


@dataclass(frozen=True, kw_only=True)
class DetectOptions:
    """What to detect in, and how; see `DetectorSettings` for the detector's own."""

    out: Path
    capture: Path | None = None
    labels: Path | None = None
    model: Path | None = None
    retrain_from: Path | None = None
    save_model: Path | None = None
    features: Path | None = None
    threshold: float = 1.0
    false_alarms_per_hour: float = 0.0
    mode: Mode = "reference"
    fm_grace: int = 5_000
    ad_grace: int = 50_000
    max_ae: int = 10


def detect(
    options: DetectOptions,
    progress: Progress = lambda _packets, _alerts: None,
    source: Iterable[Batch] | None = None,
) -> dict[str, Any]:
    """Scores all packets of `options.capture` (or of `source`) and writes everything into `options.out`.

    Returns the summary.  Raises `BadInput`: no capture, capture shorter than training, labels or model
    that do not fit, a folder that cannot be written.  Files appear only when they are whole.
    """
    if source is None and options.capture is None:
        raise BadInput("no capture and no interface; give a pcap, pcapng or tshark table, or --interface")
    capture = CaptureSource(options.capture) if options.capture is not None else None
    detector = _detector(options)
    labels = read_labels(options.labels) if options.labels else None
    run = _Run(detector)
    with OutputFolder(options.out, options.features) as output:
        for batch in source if source is not None else capture or ():
            output.write_features(run.take(batch))
            progress(run.packets, len(run.alerts))
        run.end()
        _check_length(options, run)
        labels = labels.for_packets(run.packets) if labels is not None else None
        summary = _summary(options, run, labels)
        if capture is not None and capture.note:
            summary["warnings"].append(capture.note)
        if options.save_model is not None:
            _saved(detector, options.save_model)
        output.write(
            times_ns=run.times_ns,
            scores=run.scores,
            states=run.states,
            alerts=run.alerts,
            labels=labels,
            line=detector.threshold,
            summary=summary,
        )
    return summary


class _Run:
    """Collects what the detector says."""

    def __init__(self, detector: Detector) -> None:
        self.detector = detector
        self.alerts: list[Alert] = []
        self.packets = 0
        self._times: list[npt.NDArray[np.int64]] = []
        self._scores: list[npt.NDArray[np.float64]] = []
        self._states: list[npt.NDArray[np.uint8]] = []

    def take(self, batch: Batch) -> npt.NDArray[np.float64]:
        scored, alerts = self.detector.process(batch)
        self.alerts += alerts
        self.packets += len(scored.scores)
        self._times.append(np.asarray(batch["time_ns"]))
        self._scores.append(scored.scores)
        self._states.append(scored.state)
        return scored.features

    def end(self) -> None:
        self.alerts += self.detector.finish()
        self.times_ns = np.concatenate([np.zeros(0, np.int64), *self._times])
        self.scores = np.concatenate([np.zeros(0), *self._scores])
        self.states = np.concatenate([np.zeros(0, np.uint8), *self._states])
        if self.packets:
            self.detector.calibration.close(self.times_ns[-1] / 1e9)


def _detector(options: DetectOptions) -> Detector:
    if options.model and options.retrain_from:
        raise BadInput(
            "--model and --retrain-from cannot be combined: the first scores, the second continues training"
        )
    path, kernel = options.model or options.retrain_from, load_kernel()
    try:
        settings = DetectorSettings(
            fm_grace=options.fm_grace,
            ad_grace=options.ad_grace,
            max_ae=options.max_ae,
            mode=options.mode,
            threshold=options.threshold,
            false_alarms_per_hour=options.false_alarms_per_hour,
        )
        model = load_model(path, clip=settings.scale_limit, kernel=kernel) if path else None
        return Detector(settings, model=model, retrain=options.retrain_from is not None, kernel=kernel)
    except ValueError as error:
        raise BadInput(str(error)) from error


def _check_length(options: DetectOptions, run: _Run) -> None:
    needed = run.detector.model.training_packets
    if run.packets and not run.detector.model.is_trained:
        raise BadInput(
            f"{options.capture or 'interface'}: {run.packets:,} packets, and training alone needs {needed:,} "
            f"(--fm-grace {options.fm_grace} + --ad-grace {options.ad_grace} + 1); lower these options, "
            "give a longer capture, or use --model with a trained model"
        )


def _saved(detector: Detector, path: Path) -> None:
    try:
        detector.save(path)
    except ModelFileError as error:
        raise BadInput(str(error)) from error


def _summary(options: DetectOptions, run: _Run, labels: Labels | None) -> dict[str, Any]:
    detector = run.detector
    scored = run.states == SCORED
    scores = run.scores[scored]
    finite = scores[np.isfinite(scores)]
    summary: dict[str, Any] = {
        "capture": str(options.capture or "interface"),
        "packets": run.packets,
        "training_packets": int(np.count_nonzero(~scored)),
        "scored": len(scores),
        "not_finite": len(scores) - len(finite),
        "threshold": detector.threshold,
        "over": int(np.count_nonzero(~(scores < detector.threshold))),
        "median": float(np.median(finite)) if len(finite) else None,
        "p99": float(np.quantile(finite, 0.99)) if len(finite) else None,
        "alerts": len(run.alerts),
        "alerted_senders": sorted({alert.sender.ip or alert.sender.mac for alert in run.alerts}),
        "mode": options.mode,
        "warnings": [f"training: {warning}" for warning in detector.training_warnings],
        **detector.afterimage.counts,
    }
    summary["warnings"] += _cautions(options, run)
    if options.model and run.packets:
        summary |= _age(run, finite)
    if labels is not None:
        summary |= measures(labels.attack[scored], np.nan_to_num(scores, nan=np.inf, posinf=np.inf))
        summary["first_alert_after_onset_s"] = _delay(run, labels)
    return summary


def _age(run: _Run, scores: npt.NDArray[np.float64]) -> dict[str, Any]:
    """How old the model is, and how far benign scores have moved since (in spreads of then)."""
    detector = run.detector
    benign = detector.calibration.benign
    age = run.times_ns[0] / 1e9 - detector.trained_at_us / 1e6
    drift = None if benign is None else benign.drift(scores[scores < detector.threshold])
    return {"model_age_s": float(age), "benign_drift": drift}


def _cautions(options: DetectOptions, run: _Run) -> list[str]:
    found = []
    gaps = np.diff(run.times_ns) / 1e9
    if len(gaps) and float(np.abs(gaps).max()) > _YEAR_S:
        found.append(
            f"the capture's clock jumps by {np.abs(gaps).max() / _YEAR_S:.0f} years; rates around the jump are misleading"
        )
    if len(gaps) and float(gaps.min()) < 0 and options.mode == "bounded":
        found.append(
            f"{int(np.count_nonzero(gaps < 0)):,} packets are older than the one before: treated as simultaneous"
        )
    clipped = run.detector.model.clip
    if clipped and bool((run.scores > math.sqrt(clipped)).any()):
        found.append(
            "some scores are very high because a feature that was constant in training moved; bounded mode limits "
            f"scaled features to {clipped:g}, the published method gives scores near 1e16 there"
        )
    if not run.packets:
        found.append("no packets")
    return found


def _delay(run: _Run, labels: Labels) -> float | None:
    """Seconds of capture from the first attack packet to the end of the first anomalous second of an attacker."""
    first = labels.first_attack
    if first is None:
        return None
    onset = run.times_ns[first] / 1e9
    known = labels.attackers
    ends = [
        alert.event_time / 1e9
        for alert in run.alerts
        if alert.event_time / 1e9 >= onset and (not known or {alert.sender.ip, alert.sender.mac} & known)
    ]
    return min(ends) - onset if ends else None
