"""Refinement finds what lasts, finds nothing else, and takes little of the switch while nothing crosses."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apps.sonata_adapter.control import Control
from apps.sonata_adapter.planner.placement import SwitchLimits
from apps.sonata_adapter.planner.refinement import MOST
from apps.sonata_adapter.query.catalogue import CATALOGUE
from sdnator.testing.query_traffic import ACK, BASE_US, SYN, TimedFrame, batch_of, tcp, udp
from tests.apps.sonata_adapter.query.test_catalogue import expect, same
from tests.apps.sonata_adapter.switch_model import SwitchModel
from tests.apps.sonata_adapter.test_control import rows

PREFIX = "network.traffic_query.sonata"
WINDOW_US = 1_000_000
COUNTED = ("new_tcp", "ssh_brute_force", "superspreader", "port_scan", "ddos")


def peer(host, number):
    return f"2001:db8:{number:x}::9" if ":" in host else f"10.7.{number // 250}.{number % 250 + 1}"


def frame(name, host, number):
    """The frame of an attack that makes its count `number`."""
    other = peer(host, number)
    return {
        "new_tcp": lambda: tcp(other, host, 5000, 80, SYN),
        "ssh_brute_force": lambda: tcp(other, host, 5000, 22, ACK, bytes(90)),
        "superspreader": lambda: udp(host, other, 4000, 4000),
        "port_scan": lambda: tcp(host, peer(host, 0), 4000, number, SYN),
        "ddos": lambda: udp(other, host, 4000, 4000),
    }[name]()


def attack(name, host, counts):
    """Frames with which the host's count in window n is `counts[n]`, in the first half of the window."""
    frames = []
    for window, count in enumerate(counts):
        for place in range(count):
            at = BASE_US + window * WINDOW_US + place * WINDOW_US // 2 // count
            frames.append(TimedFrame(at, 120, frame(name, host, place + 1)))
    return frames


def play(name, refine, frames, *, limits=None, shrink=0, ahead_us=0):
    """Results of a refined query with threshold 5, and the most entries and copies at the end of a window.

    With `ahead_us` all frames come before as well, of a clock that is so far ahead and then set right.
    """
    control, switch = Control(CATALOGUE, limits=limits), SwitchModel(shrink=shrink)
    control.switch("s1", 0)
    switch.change(control.want([f"{PREFIX}.{name}:window=1s,threshold=5,refine={refine}"]))
    frames = sorted(frames)
    written, held, first = [], [], 0
    halves = range(2 * (1 + (frames[-1].time_us - BASE_US) // WINDOW_US))
    for half, wrong_us in (
        (half, wrong_us) for wrong_us in sorted({ahead_us, 0}, reverse=True) for half in halves
    ):
        if ahead_us and not half + wrong_us:
            written += control.set_back("s1", BASE_US)
        begin = BASE_US + half * WINDOW_US // 2 + wrong_us
        moved = (each._replace(time_us=each.time_us + wrong_us) for each in frames)
        part = [each for each in moved if begin <= each.time_us < begin + WINDOW_US // 2]
        for (kind, which), sent in switch.process(batch_of(part, first)).items() if part else ():
            if kind == "digests":
                written += control.digests("s1", which, sent)
            else:
                written += control.packets("s1", which, sent, half)
        first += len(part)
        control.advance("s1", begin + WINDOW_US // 2)
        written += control.tick(half + 0.5)
        changes = control.refine()
        if changes is not None:
            switch.change(changes)
        held.append(len(switch.offers))
    written += control.finish()
    assert all(one.keys for one in written)
    return [one.output for one in written], held


def truth(name, frames):
    return expect(name, sorted(frames), {"window": 1000, "threshold": 5})


def keys(found):
    return {(each.window - BASE_US // WINDOW_US, each.fields) for each in found}


@pytest.mark.parametrize("host", ["198.51.100.1", "2001:db8::5"])
@pytest.mark.parametrize("name", COUNTED)
def test_attack_that_lasts_is_found(name, host):
    """From as many windows on as there are levels the results are the naive evaluator's, and none other before."""
    frames = attack(name, host, [8] * 7)
    results, _ = play(name, "8/16", frames)
    found, whole = keys(rows(results)), keys(truth(name, frames))
    assert len(found) == len(results)
    assert found <= whole
    assert {each for each in whole if each[0] >= 2} <= found
    assert all(result.exact for result in results)


def test_a_clock_that_is_set_back_leaves_no_finer_counts_behind():
    """What crossed in the wrong time is forgotten; the right windows have their results once, as if nothing had been."""
    day = 86_400 * WINDOW_US
    frames = attack("ddos", "203.0.113.9", [1] * 10) + attack("ddos", "198.51.100.1", [0, 8, 8, 8, 8])
    undisturbed, held = play("ddos", "8/16", frames)
    results, held_after = play("ddos", "8/16", frames, ahead_us=day)
    right = [each for each in results if each.window_us < BASE_US + day // 2]
    assert keys(rows(undisturbed)) == keys(rows(right))
    assert len(keys(rows(right))) == len(right)
    assert held_after[-1] == held[-1]


def test_levels_cost_no_window_where_there_is_time_left():
    """A finer count comes into force when its prefix crosses, not at the next window."""
    frames = attack("ddos", "198.51.100.1", [8] * 2) + [
        TimedFrame(BASE_US + WINDOW_US * 3 // 4 + place, 120, frame("ddos", "198.51.100.1", 20 + place))
        for place in range(6)
    ]
    results, _ = play("ddos", "16", frames)
    assert {each[0] for each in keys(rows(results))} == {0, 1}
    assert results[0].partial


def test_finer_counts_leave_with_the_attack():
    """Before and two windows after it there is the coarse count alone."""
    quiet = attack("ddos", "203.0.113.9", [1] * 10)
    _, held = play("ddos", "16", quiet + attack("ddos", "198.51.100.1", [0, 0, 8, 8, 8]))
    assert held[0] == held[-1] == 4
    assert max(held) == 6


def test_too_many_prefixes_make_it_count_all_addresses():
    """Nothing is lost, and the coarse count stays to tell when that is over."""
    hosts = [f"{20 + place}.0.0.1" for place in range(MOST + 1)]
    frames = [each for host in hosts for each in attack("new_tcp", host, [6] * 4)]
    frames += attack("new_tcp", "198.51.100.1", [0] * 7 + [8] * 4)
    results, held = play("new_tcp", "8", frames)
    found, whole = keys(rows(results)), keys(truth("new_tcp", frames))
    assert {each for each in whole if each[0] not in (0, 7)} <= found <= whole
    assert max(held) == 3


@pytest.mark.parametrize("stages", [0, 1, 3, 5])
def test_where_room_is_short_results_are_the_same(stages):
    """Counts without room in the switch are taken on the host, of the packets that they are about."""
    frames = attack("ddos", "198.51.100.1", [8] * 6)
    results, _ = play("ddos", "8/16", frames, limits=SwitchLimits(stages=stages))
    found, whole = keys(rows(results)), keys(truth("ddos", frames))
    assert {each for each in whole if each[0] >= 2} <= found <= whole
    if stages < 2:
        assert found == whole


def test_prefixes_without_a_cell_are_looked_into():
    """Too few cells: more is counted, nothing wrong is reported and what lasts is found."""
    hosts = [f"{20 + place}.0.0.1" for place in range(8)]
    frames = [each for host in hosts for each in attack("ddos", host, [8] * 5)]
    results, _ = play("ddos", "8", frames, shrink=8192)
    found, whole = keys(rows(results)), keys(truth("ddos", frames))
    assert {each for each in whole if each[0] >= 2} <= found <= whole


_COUNTS = st.lists(st.integers(0, 9), min_size=6, max_size=6)
_HOSTS = ("198.51.100.1", "198.51.100.2", "198.51.7.1", "203.0.113.9", "20.0.0.1", "2001:db8::5")


@settings(max_examples=15, deadline=None)
@given(st.sampled_from(["new_tcp", "ddos"]), st.lists(_COUNTS, min_size=6, max_size=6))
def test_whatever_comes_and_goes(name, counts):
    """A subset of the naive results; with all that cross for as many windows as there are levels."""
    frames = [each for host, mine in zip(_HOSTS, counts, strict=True) for each in attack(name, host, mine)]
    if not frames:
        return
    results, _ = play(name, "8/16", frames)
    found, whole = keys(rows(results)), keys(truth(name, frames))
    assert len(found) == len(results)
    assert found <= whole
    lasting = {(n, fields) for n, fields in whole if {(n - 1, fields), (n - 2, fields)} <= whole}
    assert lasting <= found


def test_without_levels_nothing_is_refined():
    """`refine=none` is the query as it was, and the key says so."""
    frames = attack("ddos", "198.51.100.1", [8] * 3)
    results, held = play("ddos", "none", frames)
    same(rows(results), truth("ddos", frames))
    assert set(held) == {4}
