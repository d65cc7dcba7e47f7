"""Times of a capture for frames that went through a switch with a clock of its own.

Such a switch stamps frames with the time of the replay.  It numbers them, too, so a frame's arrival number says
which of the capture it is.
"""

import tokenize
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.messages import LATEST_NS
from apps.p4runtime_ctrl.errors import CaptureTimesError

MOST_FRAMES: Final = 100_000_000
"""As many as a replay takes."""
_LATEST_US: Final = LATEST_NS // 1000


class CaptureTimes:
    """Times by arrival number; the first frame that comes is the first of the capture.

    Args:
        times_us: absolute time of each frame, us since the epoch.
    """

    def __init__(self, times_us: NDArray[np.int64]) -> None:
        self._times_us = times_us
        self._first: int | None = None

    @classmethod
    def load(cls, path: Path) -> "CaptureTimes":
        """Times from a file of numpy's format `.npy`: int64, one number for each frame.

        Raises:
            CaptureTimesError: the file cannot be read, or holds something else.
        """
        try:
            found = np.load(path, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError, SyntaxError, tokenize.TokenError) as error:
            raise CaptureTimesError(f"times of the capture: {path} cannot be read: {error}") from None
        if not isinstance(found, np.ndarray) or found.dtype != np.int64 or found.ndim != 1:
            raise CaptureTimesError(f"times of the capture: {path} is not a list of int64")
        if not 0 < len(found) <= MOST_FRAMES:
            raise CaptureTimesError(
                f"times of the capture: {path} holds {len(found):,} times; it must hold 1 to {MOST_FRAMES:,}"
            )
        if int(found.min()) < 0 or int(found.max()) > _LATEST_US:
            raise CaptureTimesError(f"times of the capture: {path} has times before 1970 or after 2116")
        return cls(found)

    def of(self, arrival: NDArray[Any]) -> NDArray[np.int64]:
        """Time of each frame, us; frames that are none of the capture's have that of its first or last."""
        if not len(arrival):
            return np.zeros(0, np.int64)
        if self._first is None:
            self._first = int(arrival[0])
        place = np.clip(arrival.astype(np.int64) - self._first, 0, len(self._times_us) - 1)
        return np.asarray(self._times_us[place])
