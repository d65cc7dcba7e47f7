"""A capture's frames in blocks, by what its first reading has found.

In a plain pcap file a record follows the other: with the lengths known, so is where each frame begins, and a block is
one read of the file.  Other captures (pcapng, gzipped) are read frame by frame.
"""

import os
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from dataplane.frame_block import FrameBlock
from sdnator.capture.captures import Capture, MissingCapture

MAX_BYTES: Final = 1 << 26
"""On the wire, of a block with more than one frame."""
_FILE_HEADER: Final = 24
_RECORD_HEADER: Final = 16


@dataclass(frozen=True, eq=False)
class FrameIndex:
    """Frames of a capture, in order."""

    times_us: NDArray[np.int64]
    """µs since the capture's base second."""
    lengths: NDArray[np.uint32]
    """Bytes on the wire."""
    captured: NDArray[np.uint32]
    """Bytes in the file."""
    plain: bool
    """The file is pcap, and not gzipped."""


class CaptureBlocks:
    """Reads a capture a second time; a context manager.

    Args:
        path: the capture.
        index: from its first reading.

    Raises:
        CaptureError: as `Capture` does; from `take` also where the file has become shorter.
    """

    def __init__(self, path: Path, index: FrameIndex) -> None:
        self._path = path
        self._index = index
        self._taken = 0
        self._stack = ExitStack()
        self._wire = np.cumsum(index.lengths, dtype=np.int64)
        self._ends = _FILE_HEADER + np.cumsum(index.captured + np.int64(_RECORD_HEADER))
        capture = self._stack.enter_context(Capture(path))
        self._frames = iter(capture)
        self._file = self._stack.enter_context(path.open("rb")) if index.plain else None

    def take(self, most: int) -> FrameBlock:
        """The next frames.

        Args:
            most: number of frames, at least 1.

        Returns:
            At least one frame, and together at most `MAX_BYTES` on the wire if there are more.
        """
        index, first = self._index, self._taken
        before = int(self._wire[first - 1]) if first else 0
        fitting = int(np.searchsorted(self._wire, before + MAX_BYTES, side="right"))
        end = min(first + most, max(fitting, first + 1))
        self._taken = end
        some = slice(first, end)
        return FrameBlock(
            index.times_us[some], index.lengths[some], index.captured[some], self._data(first, end)
        )

    def _data(self, first: int, end: int) -> bytes:
        if self._file is None:
            return b"".join([frame.data for frame in islice(self._frames, end - first)])
        begin = int(self._ends[first]) - int(self._index.captured[first])
        size = int(self._ends[end - 1]) - begin
        read = os.pread(self._file.fileno(), size, begin)
        if len(read) < size:
            raise MissingCapture(f"{self._path}: it has become shorter during the replay; copy it again")
        ends = self._ends[first:end] - begin
        starts = ends - self._index.captured[first:end]
        view = memoryview(read)
        return b"".join(
            [view[start:stop] for start, stop in zip(starts.tolist(), ends.tolist(), strict=True)]
        )

    def close(self) -> None:
        """Close the file."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
