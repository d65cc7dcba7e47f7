"""Frames cross unchanged and in order, and are acknowledged only when they have arrived."""

import pytest

from due.backends import open_updates
from due.bridge.bridged_keys import BridgedKeys
from due.bridge.forwarder import FrameForwarder
from due.config import Options
from due.errors import Timeout
from tests.due.conftest import wait_for

COUNT = 500


class Held:
    """A publisher whose server does not answer until it is let go."""

    def __init__(self, inner) -> None:
        self._inner = inner
        self.answers = False

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def settle(self, timeout=None):
        if not self.answers:
            raise Timeout("held")
        self._inner.settle(timeout)


@pytest.fixture
def sites(request):
    """Drivers of two sites."""
    pair = [open_updates(f"memory://{request.node.name}-{name}", Options()) for name in ("near", "far")]
    yield pair
    for driver in pair:
        driver.close()


@pytest.fixture
def forwarder(sites):
    near, far = sites
    died: list[BaseException] = []
    made = FrameForwarder(
        "test",
        BridgedKeys(["a.**"]),
        near.receiver("bridge", "b1"),
        Held(far.publisher("bridge")),
        died.append,
    )
    made.target = made._target
    made.start()
    made.activate(True)
    yield made
    made.target.answers = True
    made.close()
    assert not died


def received(receiver, count):
    found = []
    wait_for(lambda: found.extend(receiver.receive(0.1)) or len(found) >= count)
    return found


def test_reliable_frames_cross_in_order_and_are_kept_until_they_have_arrived(sites, forwarder):
    near, far = sites
    reader, writer = far.receiver("app", "app1"), near.publisher("maker")
    reader.follow("a.b.*")
    assert forwarder.want(["a.b.*"]) == ("a.b.*",)
    for number in range(COUNT):
        writer.append("a.b.c", b"%d" % number)
    assert [int(d.payload) for d in received(reader, COUNT)] == list(range(COUNT))
    wait_for(lambda: forwarder.health()["unsettled"] == COUNT)
    forwarder.target.answers = True
    wait_for(lambda: forwarder.health()["unsettled"] == 0)
    assert forwarder.health()["frames"] == COUNT
    for half in (reader, writer):
        half.close()


def test_best_effort_frames_cross_at_once_and_others_do_not(sites, forwarder):
    near, far = sites
    reader, writer = far.receiver("app", "app1"), near.publisher("maker")
    reader.subscribe("**")
    forwarder.want(["a.b.*", "x.**"])
    writer.publish("x.y.z", b"not allowed")
    writer.publish("a.x.z", b"not wanted")
    writer.publish("a.b.c", b"1")
    assert [d.payload for d in received(reader, 1)] == [b"1"]
    for half in (reader, writer):
        half.close()
