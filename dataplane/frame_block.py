"""Frames end to end, with their times and lengths as columns: no Python object a frame."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class FrameBlock:
    """Frames in order.

    times_us: µs since the capture's base second
    lengths: bytes on the wire
    captured: bytes of each frame in `data`
    """

    times_us: NDArray[np.int64]
    lengths: NDArray[np.uint32]
    captured: NDArray[np.uint32]
    data: bytes

    @classmethod
    def of(
        cls, times_us: Sequence[int] | NDArray[np.int64], lengths: Sequence[int], frames: Sequence[bytes]
    ) -> Self:
        """Join frames; the three sequences have equal lengths."""
        return cls(
            np.asarray(times_us, np.int64),
            np.asarray(lengths, np.uint32),
            np.fromiter(map(len, frames), np.uint32, len(frames)),
            b"".join(frames),
        )

    def __len__(self) -> int:
        return len(self.times_us)

    def starts(self) -> NDArray[np.int64]:
        """Where each frame begins in `data`, and the end of the last."""
        return np.concatenate(([0], np.cumsum(self.captured, dtype=np.int64)))

    def part(self, first: int, end: int) -> Self:
        """Some of the frames."""
        if first == 0 and end >= len(self):
            return self
        starts = self.starts()
        return type(self)(
            self.times_us[first:end],
            self.lengths[first:end],
            self.captured[first:end],
            self.data[starts[first] : starts[min(end, len(self))]],
        )

    def padded(self) -> Self:
        """The frames as they were on the wire: what was cut off is zeros."""
        if np.array_equal(self.captured, self.lengths):
            return self
        missing = self.lengths.astype(np.int64) - self.captured
        cut = np.flatnonzero(missing)
        ends, zeros = self.starts()[1:][cut].tolist(), memoryview(bytes(int(missing.max())))
        data, pieces, begin = memoryview(self.data), list[memoryview](), 0
        for end, lacking in zip(ends, missing[cut].tolist(), strict=True):
            pieces += data[begin:end], zeros[:lacking]
            begin = end
        return type(self)(self.times_us, self.lengths, self.lengths, b"".join((*pieces, data[begin:])))

    def frames(self) -> Iterator[bytes]:
        """One frame after the other, as captured."""
        starts = self.starts().tolist()
        return (self.data[start:end] for start, end in pairwise(starts))
