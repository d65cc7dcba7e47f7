"""Benign frames of a house, over and over, into interfaces at a steady rate."""

import itertools
import time
from collections.abc import Sequence

from sdnator.capture.interfaces import WireFeed
from sdnator.datasets.mirai_like import MiraiLikeOptions, generate

SLICE_S = 0.02
"""Each interface gets its frames in bursts, one in each slice; those of several interfaces take turns within it."""
_SECONDS = 600
_FRAMES = 10_000


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
        frames = [(frame.length, frame.data) for frame in made]
        self._feeds = [(WireFeed(each), itertools.cycle(frames)) for each in interfaces]
        self.sent = 0
        """Frames, at all interfaces together."""

    def send(self, pps: float, seconds: float) -> float:
        """Send at a rate for each interface; returns the seconds that it took.

        What is late is sent as soon as possible, so that the number of frames is right.
        """
        began, slices, number = time.monotonic(), max(1, round(seconds / SLICE_S)), len(self._feeds)
        sent = [0] * number
        for turn in range(slices * number):
            done, place = divmod(turn, number)
            early = began + turn * SLICE_S / number - time.monotonic()
            if early > 0:
                time.sleep(early)
            wanted = round(pps * seconds * (done + 1) / slices)
            feed, frames = self._feeds[place]
            for length, data in itertools.islice(frames, wanted - sent[place]):
                feed.send((), (length,), (data,))
            self.sent += wanted - sent[place]
            sent[place] = wanted
        return max(seconds, time.monotonic() - began)

    def close(self) -> None:
        """Close the sockets."""
        for feed, _ in self._feeds:
            feed.close()
