"""The files of `sdnator detect`; each appears under its name only when it is whole."""

import csv
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Final, Self

import numpy as np
import numpy.typing as npt

from apps.kitsune.afterimage import WIDTH
from apps.kitsune.detector import SCORED
from apps.messages import Alert
from sdnator.capture.labels import Labels
from sdnator.errors import BadInput
from sdnator.replay.packet_accounting import PacketState
from sdnator.report.parquet import write_parquet
from sdnator.report.plots import Curve, draw

_STATES: Final = ("train", "scored")


class OutputFolder:
    """Where results go; checked for writing before the work begins.

    Raises `BadInput` when the folder or the features file cannot be written.
    """

    def __init__(self, folder: Path, features: Path | None) -> None:
        self.folder = folder
        self._features_path = features
        self._features: BinaryIO | None = None
        self._rows = 0

    def __enter__(self) -> Self:
        with _writing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            probe = _part(self.folder / "summary.json")
            probe.touch()
            probe.unlink()
        if self._features_path is not None:
            with _writing(self._features_path):
                self._features = _part(self._features_path).open("wb")
            self._write_header()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._features is None or self._features_path is None:
            return
        if kind is None:
            self._write_header()
        self._features.close()
        part = _part(self._features_path)
        if kind is None:
            part.replace(self._features_path)
        else:
            part.unlink()

    def write_features(self, features: npt.NDArray[np.float64]) -> None:
        """Appends rows of features to the features file, if there is one."""
        if self._features is not None:
            with _writing(self._features_path or self.folder):
                self._features.write(np.ascontiguousarray(features).tobytes())
            self._rows += len(features)

    def write(
        self,
        *,
        times_ns: npt.NDArray[np.int64],
        scores: npt.NDArray[np.float64],
        states: npt.NDArray[np.uint8],
        alerts: Sequence[Alert],
        labels: Labels | None,
        line: float,
        summary: dict[str, Any],
    ) -> None:
        """Writes all files; the summary last."""
        with _writing(self.folder):
            self._file("scores.csv", lambda path: _write_scores(path, times_ns, scores, states))
            self._file("scores.parquet", lambda path: write_parquet(path, _table(times_ns, scores, states)))
            self._file("alerts.csv", lambda path: _write_alerts(path, alerts))
            if len(scores):
                curve = _curve(times_ns, scores, states, labels)
                self._file("scores.png", lambda path: _write_bytes(path, draw([curve], line=line)))
            self._file(
                "summary.json", lambda path: _write_bytes(path, json.dumps(summary, indent=1).encode())
            )

    def _file(self, name: str, write: Callable[[Path], None]) -> None:
        part = _part(self.folder / name)
        try:
            write(part)
            part.replace(self.folder / name)
        finally:
            part.unlink(missing_ok=True)

    def _write_header(self) -> None:
        """The header has room for any number of rows, so that it can be written again at the end."""
        if self._features is not None:
            self._features.seek(0)
            header = {"descr": "<f8", "fortran_order": False, "shape": (self._rows, WIDTH)}
            np.lib.format.write_array_header_1_0(self._features, header)
            if self._rows:
                self._features.seek(0, os.SEEK_END)


class _writing:  # noqa: N801 - reads like a function
    """Turns an OSError into a sentence."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> None: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, OSError):
            raise BadInput(
                f"{self._path}: cannot be written ({error.strerror}); name another place"
            ) from error


def _part(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.part")


def _write_bytes(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def _table(
    times_ns: npt.NDArray[np.int64], scores: npt.NDArray[np.float64], states: npt.NDArray[np.uint8]
) -> dict[str, npt.NDArray[Any]]:
    whole, rest = np.divmod(times_ns, 1_000_000_000)
    return {
        "index": np.arange(len(scores), dtype=np.int64),
        "time": whole + rest / 1e9,
        "score": scores,
        "state": np.array(_STATES)[(states == SCORED).astype(int)],
    }


def _write_scores(
    path: Path,
    times_ns: npt.NDArray[np.int64],
    scores: npt.NDArray[np.float64],
    states: npt.NDArray[np.uint8],
) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["index", "time", "score", "state"])
        rows = zip(times_ns.tolist(), scores.tolist(), states.tolist(), strict=True)
        for index, (time, score, state) in enumerate(rows):
            writer.writerow(
                [index, f"{time // 10**9}.{time % 10**9:09d}", repr(score), _STATES[state == SCORED]]
            )


def _write_alerts(path: Path, alerts: Sequence[Alert]) -> None:
    names = (
        "first_packet",
        "packets",
        "over",
        "peak_score",
        "anomalous_seconds",
        "rate",
        "training_rate",
        "role",
        "reason",
    )
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time", "mac", "ip", *names])
        for alert in alerts:
            time = f"{alert.event_time // 10**9}"
            writer.writerow(
                [time, alert.sender.mac, alert.sender.ip, *(getattr(alert, name) for name in names)]
            )


def _curve(
    times_ns: npt.NDArray[np.int64],
    scores: npt.NDArray[np.float64],
    states: npt.NDArray[np.uint8],
    labels: Labels | None,
) -> Curve:
    is_scored = states == SCORED
    return Curve(
        title="Kitsune: anomaly score of each packet",
        time_s=(times_ns - times_ns[0]) / 1e9,
        score=np.where(is_scored, scores, np.nan),
        state=np.where(is_scored, PacketState.SCORED, PacketState.TRAIN).astype(np.uint8),
        attack=None if labels is None else labels.attack,
    )
