"""Harmless frames of a house, over and over, into interfaces at a steady rate."""

import itertools
import time
from collections.abc import Sequence

from sdnator.capture.interfaces import WireFeed
from sdnator.datasets.mirai_like import MiraiLikeOptions, generate

_SECONDS = 600
_FRAMES = 10_000
_SLICE_S = 0.005


class SteadyLoad:
    """Sends the same frames into each interface; needs root.

    Args:
        interfaces: their names.

    Raises:
        BadInput: no such interface, or no permission.
    """

    def __init__(self, interfaces: Sequence[str]) -> None:
        options = MiraiLikeOptions(benign_seconds=_SECONDS, attack_seconds=0)
        made = itertools.islice(generate(options), _FRAMES)
        self._frames = itertools.cycle([(frame.length, frame.data) for frame in made])
        self._feeds = [WireFeed(each) for each in interfaces]
        self.sent = 0
        """Frames, at all interfaces together."""

    def send(self, pps: float, seconds: float) -> float:
        """Send at a rate for each interface; returns the seconds that it took.

        What is late is sent as soon as possible, so that the number of frames is right.
        """
        began = time.monotonic()
        for number in range(round(pps * seconds)):
            due = began + number / pps
            while (early := due - time.monotonic()) > 0:
                time.sleep(max(early, _SLICE_S))
            length, data = next(self._frames)
            for feed in self._feeds:
                feed.send((), (length,), (data,))
                self.sent += 1
        return time.monotonic() - began

    def close(self) -> None:
        """Close the sockets."""
        for feed in self._feeds:
            feed.close()
