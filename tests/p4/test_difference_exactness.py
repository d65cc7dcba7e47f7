"""Whatever comes: what the switch reports of a difference, and what a host adds to it, is what counting gives."""

from collections import defaultdict

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.dataplane.loading import MAKERS, sdnator
from tests.p4.counting_switch import (
    ADDS,
    ANSWERS,
    FRAME_BYTES,
    SUBTRACTS,
    ZERO,
    answer,
    ask,
    clear_cells,
    counts,
    difference,
    send,
    sweep,
    told,
    want_by_port,
)
from tests.p4.sdnator_switch import made

WINDOW_US = 1000
HOSTS = 5
SWEEP = 0
"""In the place of a port: a packet-out."""
EVENTS = st.tuples(
    st.sampled_from((ADDS, ADDS, ANSWERS, SUBTRACTS, SWEEP)),
    st.integers(1, HOSTS),
    st.sampled_from((0, 0, 1, 300, 999, 1000, 1700, 3000)),
    st.sampled_from((0, 0, 20)),
)
"""Port, host, µs since the event before, bytes that its frame is longer."""


@pytest.fixture(scope="module", params=MAKERS)
def twin(request):
    """A switch of its own: hypothesis runs many cases on one."""
    switch = made(sdnator(), request.param)
    want_by_port(switch)
    yield switch
    assert switch.out_of_range() == {}
    switch.close()


class Host:
    """The host's part: it counts what overflows, and reads what the switch cannot be trusted to report."""

    def __init__(self, switch, by_bytes):
        self.switch, self.by_bytes = switch, by_bytes
        self.true, self.overflown = defaultdict(int), defaultdict(int)
        self.reported, self.read = {}, {}
        self.doubtful = set()
        self.now = 0

    def frame(self, port, host, more):
        key = self.now // WINDOW_US, host
        step = (-1 if port == SUBTRACTS else 1) * (FRAME_BYTES + more if self.by_bytes else 1)
        self.true[key] += step
        result = send(self.switch, port, host, self.now, more=more)
        for digest in told(result):
            assert (digest.queries, digest.crossed | digest.overflow) == (0, 1 << (port - 1))
            self.doubtful.add(key)
            self.overflown[key] += step if digest.overflow else 0
        self.hear(result)

    def hear(self, result):
        assert len(result.digests) <= 1
        for count in counts(result):
            key = count.window, count.host
            assert count.query == 0
            assert count.window < self.now // WINDOW_US, "its window is not over"
            assert key not in self.reported, "reported twice"
            self.reported[key] = count.count

    def pass_time(self, step):
        """Before a window's end the host asks for what it is in doubt of."""
        if self.now // WINDOW_US != (self.now + step) // WINDOW_US:
            for window, host in self.doubtful:
                asked = ask(self.switch, source=0x0A000000 + host, timestamp=self.now)
                assert asked.window == window
                self.read[window, host] = asked.count - ZERO
            self.doubtful.clear()
        self.now += step

    def empty(self):
        """All that waits is heard of, however far the ring is."""
        self.pass_time(WINDOW_US)
        for _ in range(4 * HOSTS):
            result = sweep(self.switch, self.now, always=True)
            self.hear(result)
            if not answer(result).count:
                return
        raise AssertionError("the ring has no end")

    def results(self, threshold):
        found = {}
        for key in self.reported.keys() | self.read.keys() | self.overflown.keys():
            inside = self.reported.get(key, self.read.get(key, 0))
            assert self.read.get(key, inside) == inside
            found[key] = inside + self.overflown.get(key, 0)
        return {key: count for key, count in found.items() if count >= threshold}


@settings(max_examples=75, deadline=None)
@given(
    events=st.lists(EVENTS, max_size=80),
    threshold=st.integers(1, 3),
    size=st.integers(1, 4),
    base=st.sampled_from((0, 7)),
    by_bytes=st.booleans(),
    generation=st.integers(1, 255),
)
def test_a_difference_is_exact(twin, events, threshold, size, base, by_bytes, generation):
    clear_cells(twin)
    twin.tables["ingress.count_0.queries"].clear()
    threshold = threshold * FRAME_BYTES if by_bytes else threshold
    options = {"size": size, "base": base, "by_bytes": int(by_bytes), "generation": generation}
    difference(twin, threshold, WINDOW_US, **options)
    host = Host(twin, by_bytes)
    for port, number, step, more in events:
        host.pass_time(step)
        if port == SWEEP:
            host.hear(sweep(twin, host.now))
        else:
            host.frame(port, number, more)
    host.empty()
    assert host.results(threshold) == {key: count for key, count in host.true.items() if count >= threshold}
