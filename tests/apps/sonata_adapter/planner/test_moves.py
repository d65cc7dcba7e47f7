"""Queries move between switch and host as the traffic changes, and lose no window."""

from itertools import count

import pytest

from apps.sonata_adapter.control import Control
from apps.sonata_adapter.keys import request_of
from apps.sonata_adapter.planner.moves import Moves
from apps.sonata_adapter.planner.placement import SwitchLimits
from apps.sonata_adapter.planner.rates import MeasuredRates
from apps.sonata_adapter.query.catalogue import CATALOGUE
from sdnator.testing.query_traffic import ACK, BASE_US, PSH, TimedFrame, batches, tcp
from tests.apps.sonata_adapter.query.test_catalogue import expect, same
from tests.apps.sonata_adapter.switch_model import SwitchModel, matches
from tests.apps.sonata_adapter.test_control import ending, rows

PREFIX = "network.traffic_query.sonata"
SSH, SPREAD, OPENED = f"{PREFIX}.ssh_brute_force", f"{PREFIX}.superspreader:src=10.0.0.9", f"{PREFIX}.new_tcp"
SECONDS = 50


def guessing(*, per_s):
    """Frames of one length to port 22 of two hosts, from ever other senders; and one host that contacts many."""
    numbers, frames = count(), []
    for second in range(SECONDS):
        for place in range(per_s):
            n = next(numbers)
            at = BASE_US + second * 10**6 + place * 10**6 // per_s
            source = f"10.{1 + n % 5}.{n // 250 % 250}.{n % 250}"
            frames.append(TimedFrame(at, 80, tcp(source, f"192.0.2.{n % 2}", 4000, 22, PSH | ACK, bytes(26))))
        for place in range(20):
            to = f"198.51.100.{(second * 20 + place) % 250}"
            frames.append(TimedFrame(BASE_US + second * 10**6 + place, 60, tcp("10.0.0.9", to, 5000, 80, 2)))
    return ending(sorted(frames))


class Played:
    """A control and a model of the switch, with the counters of its entries."""

    def __init__(self, keys, *, stages):
        self.control, self.switch = Control(CATALOGUE, limits=SwitchLimits(stages=stages)), SwitchModel()
        self.control.switch("s1", 0)
        self.switch.change(self.control.want(keys))
        self.met: dict[int, int] = {}
        self.found: dict[str, list] = {}
        self.places: list[dict[str, bool]] = []

    def play(self, frames, *, then_want=None):
        """Halfway, other keys are wanted."""
        pieces = list(batches(frames, 256))
        for now, batch in enumerate(pieces):
            if then_want is not None and now == len(pieces) // 2:
                assert self.control.health()["moved"] == 0
                self.switch.change(self.control.want(then_want))
            for (kind, name), sent in self.switch.process(batch).items():
                took = self.control.digests if kind == "digests" else self.control.packets
                self.keep(took("s1", name, sent, *([] if kind == "digests" else [now])))
            for bit, entry in self.control.plan.entries.items():
                packets = ({name: batch[name][row] for name in batch.columns} for row in range(len(batch)))
                self.met[bit] = self.met.get(bit, 0) + sum(matches(entry.match, one) for one in packets)
            at_us = int(batch["time_us"][-1])
            self.control.advance("s1", at_us)
            self.keep(self.control.tick(now + 0.5))
            self.control.measured("s1", self.met, at_us)
            changes = self.control.weigh(now)
            if changes is not None:
                self.switch.change(changes)
            places = self.control.health()["queries"]
            self.places.append({key.partition(":")[0]: place == "switch" for key, place in places.items()})

    def keep(self, written):
        for one in written:
            for key in one.keys:
                self.found.setdefault(key.partition(":")[0], []).append(one.output)

    def finish(self):
        self.keep(self.control.finish())
        self.switch.change(self.control.want([]))
        assert self.switch.empty

    def results(self, name):
        return rows(self.found.get(f"{PREFIX}.{name}", []))


def test_what_saves_more_than_was_thought_takes_the_place_of_what_saves_less():
    """Rough shares put the spreader into the switch; the traffic is all SSH, so they change places, and lose nothing."""
    frames = guessing(per_s=300)
    run = Played([SSH, SPREAD], stages=2)
    run.play(frames)
    run.finish()
    ssh, spread = f"{PREFIX}.ssh_brute_force", f"{PREFIX}.superspreader"
    assert (run.places[0][ssh], run.places[0][spread]) == (False, True)
    assert (run.places[-1][ssh], run.places[-1][spread]) == (True, False)
    assert run.control.health()["moved"] == 2
    same(run.results("ssh_brute_force"), expect("ssh_brute_force", frames))
    same(run.results("superspreader"), expect("superspreader", frames, {"src": "10.0.0.9"}))


def test_room_that_becomes_free_is_used_when_a_window_is_over():
    """The query that stays finds in every window what it finds undisturbed."""
    frames = guessing(per_s=60)
    run = Played([SSH, OPENED], stages=2)
    run.play(frames, then_want=[SSH])
    run.finish()
    assert (run.places[0][SSH], run.places[-1][SSH]) == (False, True)
    assert run.control.health()["moved"] == 1
    same(run.results("ssh_brute_force"), expect("ssh_brute_force", frames))
    assert run.results("ssh_brute_force")


def test_little_traffic_moves_nothing():
    """A gain of a few copies a second is not worth it."""
    run = Played([SSH, SPREAD], stages=2)
    run.play(guessing(per_s=30)[:-5])
    assert run.control.health()["moved"] == 0


def test_a_move_ends_though_the_clock_is_set_back():
    """The new count begins as much earlier, with a whole window."""
    request = request_of(OPENED, CATALOGUE)
    moves = Moves()
    moves.counts({request.identity: request})
    moves.begin(request, "host", {"s1": 86_400_000_000})
    moves.set_back("s1", -86_399_000_000)
    old, new = moves.counts({request.identity: request})
    assert [moves.accepts(count, "s1", 0) for count in (old, new)] == [True, False]
    assert [moves.accepts(count, "s1", 3_000_000) for count in (old, new)] == [False, True]
    assert not moves.end({"s1": 8_999_999})
    assert moves.end({"s1": 9_000_000})


@pytest.mark.parametrize(
    ("totals", "expected"),
    [
        ([(100, 0)], None),
        ([(100, 0), (200, 500_000)], None),
        ([(100, 0), (200, 500_000), (400, 1_000_000)], 300.0),
        ([(100, 0), (400, 1_000_000), (50, 2_000_000)], 300.0),
        ([(100, 0), (400, 1_000_000), (50, 2_000_000), (60, 4_000_000)], 5.0),
    ],
)
def test_rates_are_over_a_second_and_begin_anew_with_a_counter(totals, expected):
    rates = MeasuredRates()
    for packets, time_us in totals:
        rates.note("s1", "q1", {"protocol": 6}, packets, time_us)
    assert rates.of({"protocol": 6}) == expected


def test_rates_of_switches_add_up_and_of_several_counters_the_largest_counts():
    rates = MeasuredRates()
    for switch, name, packets in (("s1", "q1", 100), ("s1", "q2", 40), ("s2", "q1", 7)):
        rates.note(switch, name, {}, 0, 0)
        rates.note(switch, name, {}, packets, 1_000_000)
    assert rates.of({}) == 107
    rates.keep(["q2"])
    assert rates.of({}) == 40
