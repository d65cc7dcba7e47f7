"""Differences that the switch counts: it tells what is over when a window is, the host adds the rest."""

import pytest

from apps.sonata_adapter.control import Control
from apps.sonata_adapter.query.catalogue import CATALOGUE
from sdnator.testing.query_traffic import BASE_US, TimedFrame, batch_of, tcp
from tests.apps.sonata_adapter.switch_model import SwitchModel, counts_of
from tests.apps.sonata_adapter.test_control import answered

SYN_FLOOD = "network.traffic_query.sonata.syn_flood"
SYN, ACK = 2, 16


def segments(second, number, target="10.1.1.1", flags=SYN):
    return [
        TimedFrame(BASE_US + round(second * 1e6) + n, 60, tcp("10.0.0.9", target, 1000 + n, 80, flags))
        for n in range(number)
    ]


class Network:
    """A switch under one adapter."""

    def __init__(self, key=SYN_FLOOD, **model):
        self.control = Control(CATALOGUE)
        self.switch = SwitchModel(base_us=BASE_US, **model)
        self.control.switch("s1", BASE_US)
        self.switch.change(self.control.want([key]))
        self.written = []

    def play(self, frames, now, *, deaf=False):
        """What the switch sends for the frames; `deaf`: it is lost."""
        for (kind, name), sent in self.switch.process(batch_of(frames)).items():
            if deaf:
                continue
            if kind == "counts":
                self.written += self.control.counts("s1", name, sent, now)
            else:
                self.written += self.control.digests("s1", name, sent)

    def look(self, now):
        """Questions answered, and what waited long enough let go; returns the questions."""
        asked = self.control.reads(now)
        answered(self.control, self.switch, asked, now, self.written)
        self.written += self.control.tick(now)
        return asked.get("s1", [])

    @property
    def results(self):
        found = [one.output for one in self.written]
        return [((each.window_us - BASE_US) // 3_000_000, each.fields, each.exact) for each in found]


def test_keys_that_are_over_at_the_end_are_the_only_tuples():
    """One that came down again within its window costs nothing."""
    network = Network()
    network.play([*segments(0.1, 5, "10.1.1.2"), *segments(0.2, 4)], 0.0)
    network.play([*segments(0.3, 4, "10.1.1.2", ACK), *segments(3.1, 3, "10.1.1.3", ACK)], 0.1)
    network.look(1.0)
    assert network.results == [(0, {"dst": "10.1.1.1", "count": 4}, True)]
    assert network.control.health()["tuples"] == {f"{SYN_FLOOD}:dst=any,threshold=3,window=3s": 1}


def test_a_switch_without_frames_is_asked_to_look():
    """What waits when traffic ends is known a window later, whatever number of keys."""
    network = Network()
    targets = [f"10.1.2.{n}" for n in range(1, 30)]
    network.play([frame for n, target in enumerate(targets) for frame in segments(n / 100, 3, target)], 0.0)
    network.look(0.0)
    network.switch.rings[0].newest = 1  # its clock goes on
    asked = [len(network.look(3.1 + n / 100)) for n in range(60)]
    assert sum(asked) >= len(targets)
    assert sorted(fields["dst"] for _, fields, _ in network.results) == sorted(targets)
    assert not any(network.look(4.0 + n / 10) for n in range(10)), "once in a window"


def test_at_the_end_of_all_what_waits_is_fetched():
    """Windows that are not over are reported when no more frames will come."""
    network = Network()
    network.play(segments(0.1, 3), 0.0)
    now = 0.1
    answered(network.control, network.switch, network.control.last_reads(now), now, network.written)
    while network.control.waits_for_cells(now):
        now += 0.01
        answered(network.control, network.switch, network.control.last_reads(now), now, network.written)
    network.written += network.control.finish()
    assert network.results == [(0, {"dst": "10.1.1.1", "count": 3}, True)]


def test_a_key_without_room_to_wait_is_read():
    """The switch says that the key reached the threshold; its cell tells the rest when the window is over."""
    network = Network()
    network.play(segments(0.1, 9), 0.0)
    network.switch.rings[0].waits.clear()
    batch = batch_of(segments(0.1, 1))
    flags = {"crossed": batch["port"] * 0 + 1, "overflow": batch["port"] * 0}
    network.control.digests("s1", "q0", type(batch)({**batch, **flags}))
    network.control.advance("s1", BASE_US + 3_800_000)
    network.look(1.0)
    network.look(1.1)
    assert network.results == [(0, {"dst": "10.1.1.1", "count": 9}, True)]


@pytest.mark.parametrize("late", [False, True])
def test_frames_without_a_cell_are_added(late):
    """A key whose cell still waits for an older window is counted here; read too late it is an estimate."""
    network = Network()
    network.play(segments(0.1, 4), 0.0)
    network.play(segments(6.1, 4), 0.1)
    network.control.advance("s1", BASE_US + (12_100_000 if late else 9_800_000))
    for n in range(3):
        network.look(0.2 + n / 10)
    network.play(segments(15.1, 1, "10.1.1.9", ACK), 0.6)
    network.look(1.0)
    assert sorted(network.results) == [
        (0, {"dst": "10.1.1.1", "count": 4}, True),
        (2, {"dst": "10.1.1.1", "count": 4}, not late),
    ]
    assert bool(network.control.health()["late_reads"]) == late


def test_a_report_that_comes_twice_makes_one_result():
    """A frame that comes behind its window makes the switch report its key again."""
    network = Network()
    told = [{"query": 0, "source": 0, "destination": 0x0A010101, "port": 0, "length": 0, "source_port": 0,
             "window": 7, "count": 5, "time_us": BASE_US}]  # fmt: skip
    for now in (0.0, 1.0):
        network.control.counts("s1", "q0", counts_of(told), now)
        network.look(now + 0.5)
    assert network.results == [(7, {"dst": "10.1.1.1", "count": 5}, True)]
    assert network.control.health()["late_reads"] == 1


def test_short_windows_are_counted_in_the_switch_and_told_at_once():
    """Windows of 100 ms: the result comes with the report, without a look or a tick."""
    network = Network(f"{SYN_FLOOD}:window=100ms")
    assert network.control.plan.queries[0].in_switch
    network.play(segments(0.02, 4), 0.0)
    assert network.written == []
    network.play(segments(0.12, 1, "10.1.1.9"), 0.1)
    (one,) = network.written
    assert (one.output.fields, one.output.length_us, one.output.exact) == (
        {"dst": "10.1.1.1", "count": 4},
        100_000,
        True,
    )
