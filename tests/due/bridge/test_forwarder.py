"""Frames cross unchanged and in order, and are acknowledged only when they have arrived."""

import threading
import time

import pytest

from due.backends import open_updates
from due.bridge.bridged_keys import BridgedKeys
from due.bridge.forwarder import FrameForwarder
from due.config import Options
from due.errors import BackendError, Timeout
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


class Stuck:
    """A publisher whose connection takes nothing: whoever uses it waits, as on a link that was cut silently."""

    def __init__(self, inner) -> None:
        self._inner = inner
        self.whole = threading.Event()

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def append(self, path, payload):
        self.whole.wait()
        self._inner.append(path, payload)

    def poll(self):
        self.whole.wait()
        return self._inner.poll()


class Renewing:
    """A receiver that counts the renewals of its leases."""

    def __init__(self, inner) -> None:
        self._inner = inner
        self.renewals = 0

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def renew(self):
        self.renewals += 1
        self._inner.renew()


def test_a_link_that_takes_nothing_keeps_the_leases_of_this_site(sites):
    """Otherwise the producers here would no longer wait for the bridge, and what waits would be lost."""
    near, far = sites
    source, target = Renewing(near.receiver("bridge", "b1")), Stuck(far.publisher("bridge"))
    died: list[BaseException] = []
    forwarder = FrameForwarder("test", BridgedKeys(["a.**"]), source, target, died.append)
    forwarder.start()
    forwarder.activate(True)
    forwarder.want(["a.b.*"])
    reader, writer = far.receiver("app", "app1"), near.publisher("maker")
    reader.follow("a.b.*")
    writer.append("a.b.c", b"1")
    wait_for(lambda: forwarder._busy)
    before = source.renewals
    wait_for(lambda: source.renewals >= before + 3)
    target.whole.set()
    assert [d.payload for d in received(reader, 1)] == [b"1"]
    forwarder.close()
    for half in (reader, writer):
        half.close()
    assert not died


def test_on_a_long_way_a_short_lull_is_no_reason_to_wait_for_arrivals(sites):
    """What comes meanwhile would wait, too: more is awaited for as long as the arrival took."""
    near, far = sites

    class Distant(Held):
        def settle(self, timeout=None):
            time.sleep(0.2)
            self._inner.settle(timeout)

    died: list[BaseException] = []
    target = Distant(far.publisher("bridge"))
    forwarder = FrameForwarder(
        "test", BridgedKeys(["a.**"]), near.receiver("bridge", "b1"), target, died.append
    )
    forwarder.start()
    forwarder.activate(True)
    forwarder.want(["a.b.*"])
    writer = near.publisher("maker")
    writer.append("a.b.c", b"1")
    wait_for(lambda: forwarder.health()["frames"] == 1 and forwarder.health()["unsettled"] == 0)
    assert 0.2 <= forwarder._linger <= 1.0
    forwarder.close()
    writer.close()
    assert not died


class Refusing:
    """A publisher whose server takes no long payloads."""

    def __init__(self, inner) -> None:
        self._inner = inner

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def append(self, path, payload):
        self._check(path, payload)
        self._inner.append(path, payload)

    def publish(self, path, *payloads):
        self._check(path, *payloads)
        self._inner.publish(path, *payloads)

    def _check(self, path, *payloads):
        if any(len(payload) > 10 for payload in payloads):
            raise BackendError(f"{path}: Broker: Message size too large")


def test_a_frame_that_the_other_site_refuses_is_set_aside_and_the_others_cross(sites):
    """It would come again after each restart of the bridge, and nothing behind it would ever cross."""
    near, far = sites
    source, target = near.receiver("bridge", "b1"), Refusing(far.publisher("bridge"))
    died: list[BaseException] = []
    forwarder = FrameForwarder("near to far", BridgedKeys(["a.**"]), source, target, died.append)
    forwarder.start()
    forwarder.activate(True)
    forwarder.want(["a.b.*"])
    reader, writer = far.receiver("app", "app1"), near.publisher("maker")
    reader.follow("a.b.*")
    reader.subscribe("a.b.*")
    writer.publish("a.b.quick", bytes(11))
    for payload in (b"1", bytes(11), b"2"):
        writer.append("a.b.c", payload)
    assert [d.payload for d in received(reader, 2)] == [b"1", b"2"]
    wait_for(lambda: (forwarder.health()["frames"], forwarder.health()["unsettled"]) == (2, 0))
    assert forwarder.health()["refused"] == 2
    assert source.aside() == [(bytes(11), "near to far: a.b.c: Broker: Message size too large")]
    forwarder.close()
    again = near.receiver("bridge", "b2")
    again.follow("a.b.*")
    assert again.receive(0.0) == [], "everything was acknowledged"
    for half in (again, reader, writer):
        half.close()
    assert not died
