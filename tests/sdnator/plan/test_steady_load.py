"""Frames go into all interfaces, as many as the rate says, at each of them."""

from sdnator.plan import steady_load
from sdnator.plan.steady_load import SLICE_S, SteadyLoad


class FakeFeed:
    def __init__(self, interface):
        self.interface = interface
        self.bursts = []
        self.closed = False

    def send(self, _times, lengths, frames):
        assert len(lengths) == len(frames) == 1
        assert 14 <= len(frames[0]) <= lengths[0]
        self.bursts.append(frames[0])

    def close(self):
        self.closed = True


def test_each_interface_gets_the_same_frames_at_the_same_rate(monkeypatch):
    """Also where a slice is due a fraction of a frame only."""
    monkeypatch.setattr(steady_load, "WireFeed", FakeFeed)
    load = SteadyLoad(["one", "two", "three"])
    feeds = [feed for feed, _ in load._feeds]
    assert load.send(70, 10 * SLICE_S) >= 10 * SLICE_S
    assert [len(feed.bursts) for feed in feeds] == [14, 14, 14]
    assert feeds[0].bursts == feeds[1].bursts == feeds[2].bursts
    load.send(1000, SLICE_S)
    assert load.sent == 3 * (14 + 20)
    load.close()
    assert all(feed.closed for feed in feeds)
