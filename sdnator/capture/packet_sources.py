"""Packets of a capture, of tshark's table or of an interface, as record batches.

Batches carry `time_ns` beside the columns of `apps.packets`, so that a capture with nanoseconds keeps
its times.
"""

import gzip
import itertools
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from apps.packets import read_frames
from sdnator.capture.captures import Capture
from sdnator.capture.tshark_tsv import COLUMNS, as_columns, read_rows

BATCH: Final = 1_024
Batch = Mapping[str, npt.NDArray[Any]]


class CaptureSource:
    """pcap, pcapng or tshark TSV, each plain or gzipped; told by content.

    Iterating raises the reader's errors (`sdnator.errors.BadInput`).
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.is_table = _begins_with(path, "\t".join(COLUMNS[:2]).encode())
        self.note = ""
        """After reading: where a cut capture ends."""

    def __iter__(self) -> Iterator[Batch]:
        return self._rows() if self.is_table else self._frames()

    def _rows(self) -> Iterator[Batch]:
        rows, start = read_rows(self.path), 0
        while chunk := list(itertools.islice(rows, BATCH)):
            times = np.array([row.time_ns for row in chunk], dtype=np.int64)
            yield {**as_columns(chunk, start), "time_ns": times}
            start += len(chunk)

    def _frames(self) -> Iterator[Batch]:
        start = 0
        with Capture(self.path) as capture:
            frames = iter(capture)
            while chunk := list(itertools.islice(frames, BATCH)):
                times, lengths, data = zip(*chunk, strict=True)
                yield frame_batch(data, lengths, np.array(times, dtype=np.int64), start)
                start += len(chunk)
            self.note = str(capture.cut) if capture.cut else ""


def frame_batch(
    frames: tuple[bytes, ...], lengths: tuple[int, ...], times_ns: npt.NDArray[np.int64], start: int
) -> Batch:
    """Frames of port 1 as a batch; `start` is the number of the first."""
    arrival = np.arange(start, start + len(frames))
    batch = read_frames(
        frames,
        lengths=lengths,
        times_us=times_ns // 1_000,
        ports=np.ones(len(frames)),
        sequence=arrival + 1,
        arrival=arrival,
    )
    return {**batch, "time_ns": times_ns}


def _begins_with(path: Path, text: bytes) -> bool:
    try:
        with path.open("rb") as file:
            head = file.read(len(text))
        if head[:2] == b"\x1f\x8b":
            with gzip.open(path) as unpacked:
                head = unpacked.read(len(text))
    except (OSError, EOFError, zlib.error):
        return False  # the capture reader says what is wrong
    return head == text
