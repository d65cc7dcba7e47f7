"""Switch and host together find what the naive evaluator finds, and nothing is there that nobody wants."""

from typing import Any

import pytest

from apps.sonata_adapter.control import Control
from apps.sonata_adapter.controller_updates import ControllerUpdates, leftovers
from apps.sonata_adapter.planner.placement import reciprocal
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.results import Captured, QueryResult
from sdnator.testing.oracles import sonata
from sdnator.testing.query_traffic import TimedFrame, batch_of, batches, mixed, office, tcp
from tests.apps.sonata_adapter.query.test_catalogue import expect, same
from tests.apps.sonata_adapter.switch_model import SwitchModel, counts_of

PREFIX = "network.traffic_query.sonata"
DAY_US = 86_400_000_000


def play(keys, frames, *, shrink=0, size=512, limits=None, base_us=0):
    """Outputs by key, and how many tuples reached the host."""
    control, switch = Control(CATALOGUE, limits=limits), SwitchModel(shrink=shrink, base_us=base_us)
    control.switch("s1", base_us)
    changes = control.want(keys)
    assert not changes.refused
    switch.change(changes)
    written, tuples, before = [], 0, 0
    for now, batch in enumerate(batches(frames, size)):
        first = int(batch["time_us"][0])
        if first < before - DAY_US // 2:
            written += control.set_back("s1", first)
            switch.change(control.renew())
        before = first
        for (kind, name), sent in switch.process(batch).items():
            tuples += len(sent)
            if kind == "digests":
                written += control.digests("s1", name, sent)
            elif kind == "counts":
                written += control.counts("s1", name, sent, now)
            else:
                written += control.packets("s1", name, sent, now)
        control.advance("s1", int(batch["time_us"][-1]))
        tuples += answered(control, switch, control.reads(now), now, written)
        written += control.tick(now + 0.5)
    tuples += answered(control, switch, control.last_reads(now), now, written)
    while control.waits_for_cells(now):
        now += 0.5
        tuples += answered(control, switch, control.last_reads(now), now, written)
    written += control.finish()
    found: dict[str, list[Any]] = {}
    for one in written:
        for key in one.keys:
            found.setdefault(key, []).append(one.output)
    switch.change(control.want([]))
    assert switch.empty
    assert not control.sources
    return found, tuples


def answered(control, switch, asked, now, written):
    """Questions put to the switch and its answers taken; returns how many tuples that brought."""
    tuples = 0
    for read in asked.get("s1", ()):
        answer, told = switch.answer(read)
        told = list(told)
        tuples += len(told) + (answer is not None)
        if told:
            written += control.counts("s1", f"q{told[0]['query']}", counts_of(told), now)
        if answer is not None:
            written += control.cells("s1", [read.id], [answer])
    return tuples


def ending(frames):
    """A last SYN, some windows later: the switch's clock goes on, and results of the end come."""
    last = frames[-1].time_us + 120_000_000
    return [*frames, *(TimedFrame(last + n, 60, tcp("10.0.0.1", "10.0.0.2", 1, 2, 2)) for n in range(5))]


def rows(results):
    return [
        sonata.Found(r.window_us // r.length_us, tuple(sorted(r.fields.items())), r.at_us) for r in results
    ]


@pytest.fixture(scope="module")
def everything():
    return mixed(CATALOGUE, seconds=16)


@pytest.mark.parametrize("name", CATALOGUE)
def test_split_equals_naive(name, everything):
    """Each query alone: what the switch counts and what the host adds are the naive evaluator's results."""
    found, tuples = play([f"{PREFIX}.{name}"], everything)
    ((key, results),) = found.items()
    assert key.startswith(f"{PREFIX}.{name}:")
    same(rows(results), expect(name, everything))
    assert tuples < len(everything)


@pytest.mark.parametrize("name", ["new_tcp", "syn_flood", "slowloris", "dns_tunnel", "arp_scan"])
def test_a_clock_that_is_set_back_costs_no_window(name, everything):
    """It was a day ahead: all kinds of counts, in the switch and on the host, begin anew with the right time."""
    ahead = [frame._replace(time_us=frame.time_us + DAY_US) for frame in everything[: 4 * 512]]
    found, _ = play([f"{PREFIX}.{name}"], ahead + everything)
    (results,) = found.values()
    same(
        rows(one for one in results if one.window_us < everything[0].time_us + DAY_US // 2),
        expect(name, everything),
    )


def test_all_together_equal_naive(everything):
    """All at once share bits, stages and copies."""
    found, _ = play([f"{PREFIX}.{name}" for name in CATALOGUE], everything)
    for key, results in found.items():
        name = key.split(":")[0].rpartition(".")[2]
        same(rows(results), expect(name, everything))


@pytest.mark.parametrize("name", ["new_tcp", "ssh_brute_force", "superspreader", "port_scan", "ddos"])
def test_threshold_queries_send_results_only(name, everything):
    """With a cell for every key, one tuple comes for each result."""
    found, tuples = play([f"{PREFIX}.{name}"], everything)
    results = [result for each in found.values() for result in each]
    assert len(results) <= tuples <= 2 * len(results)
    assert all(result.exact for result in results)


def test_windows_with_keys_without_cells_are_estimates(everything):
    """With too few cells nothing wrong is reported, and what is reported then says that it is an estimate."""
    found, _ = play([f"{PREFIX}.superspreader:threshold=20"], everything, shrink=2048)
    (results,) = found.values()
    truth = expect("superspreader", everything, {"threshold": 20})
    keys = {(found.window, found.fields) for found in truth}
    assert all((row.window, row.fields) in keys for row in rows(results))
    assert any(not result.exact for result in results)


def test_spellings_of_one_request_share_the_switch():
    """Two keys that mean the same make one plan; each is written as it was asked for."""
    control = Control(CATALOGUE)
    changes = control.want(
        [f"{PREFIX}.new_tcp:window=3000ms", f"{PREFIX}.new_tcp", f"{PREFIX}.new_tcp:threshold=40"]
    )
    assert len(changes.offer) == 1
    assert len(control.requests) == 1
    more = control.want([f"{PREFIX}.new_tcp", f"{PREFIX}.new_tcp:window=*"])
    assert not more.offer
    assert not more.updates
    assert not more.withdraw


def test_adding_a_query_leaves_the_others_alone():
    """Entries that stay are not touched; a shared distinct is modified, not replaced."""
    control = Control(CATALOGUE)
    control.want([f"{PREFIX}.ddos"])
    changes = control.want([f"{PREFIX}.ddos", f"{PREFIX}.superspreader"])
    assert not changes.withdraw
    assert {update.kind for update in changes.updates} == {"insert", "modify"}
    back = control.want([f"{PREFIX}.ddos"])
    assert {update.kind for update in back.updates} == {"delete", "modify"}
    assert len(back.withdraw) == 2


def test_the_clock_changes_its_pace_in_place():
    """A window that it does not fit makes it faster; nothing else of what runs is touched."""
    control, switch = Control(CATALOGUE), SwitchModel()
    switch.change(control.want([f"{PREFIX}.slowloris:window=3s"]))
    changes = control.want([f"{PREFIX}.slowloris:window=3s", f"{PREFIX}.slowloris:dst=10.0.0.0/8,window=2s"])
    (modified,) = [update for update in changes.updates if update.kind != "insert"]
    assert (modified.kind, int(modified.params["reciprocal"], 16)) == ("modify", reciprocal(1_000_000))
    switch.change(changes)


@pytest.mark.parametrize(
    ("key", "text"),
    [
        (f"{PREFIX}.new_tcp:window=1ms", "100ms to 1h"),
        (f"{PREFIX}.new_tcp:threshold=0", "1 to 1000000000 SYNs"),
        (f"{PREFIX}.new_tcp:dst=hello", "10.0.0.0/8"),
        (f"{PREFIX}.new_tcp:src=10.0.0.1", "window, threshold, dst"),
        (f"{PREFIX}.nothing", "there are new_tcp"),
        ("network.traffic_capture.sonata.tcp:flag=x", "syn+ack"),
        ("network.traffic_capture.sonata.tcp:dport=70000", "0 to 65535"),
        ("network.traffic_capture.sonata.icmp:dport=7", "src, dst"),
        ("network.traffic_capture.sonata.sctp", "there are tcp"),
    ],
)
def test_refusals_say_what_would_do(key, text):
    """A wrong key takes nothing in the switch and is refused once."""
    control = Control(CATALOGUE)
    changes = control.want([key])
    ((refused, why),) = changes.refused
    assert refused == key
    assert text in why
    assert not control.sources
    assert not control.want([key]).refused


def test_raw_stream_and_handshakes(everything):
    """Raw streams are exactly the packets of the filter; a handshake needs the right acknowledgement."""
    syn = "network.traffic_capture.sonata.tcp:dport=80,flag=syn"
    found, _ = play([syn, "network.handshake.sonata.tcp"], everything)
    arrivals = [n for part in found[syn] for n in part.batch["arrival"].tolist()]
    packets = [sonata.read(*frame) for frame in everything]
    assert arrivals == [
        n for n, p in enumerate(packets) if p.flags & 0x12 == 2 and p.dport == 80 and p.protocol == 6
    ]
    assert all(isinstance(part, Captured) for part in found[syn])
    shaken = {(h.source, h.service) for h in found["network.handshake.sonata.tcp"]}
    assert ("10.9.9.9", "198.51.100.7") in shaken
    assert not any(service == "198.51.100.6" for _, service in shaken)


def test_windows_follow_the_clock_of_the_switch():
    """Window numbers count from the switch's clock zero, also on the host."""
    import random

    frames = office(7, random.Random(5))
    for key in ("new_tcp:threshold=1,window=2s", "dns_tunnel:gate=1,threshold=1,window=2s"):
        control = Control(CATALOGUE)
        control.switch("s1", frames[0].time_us - 700_000)
        control.want([f"{PREFIX}.{key}"])
        switch = SwitchModel(base_us=frames[0].time_us - 700_000)
        switch.change(control.everything())
        written = []
        for (kind, which), sent in switch.process(batch_of(frames)).items():
            if kind == "digests":
                written += control.digests("s1", which, sent)
            else:
                written += control.packets("s1", which, sent, 0)
        written += control.finish()
        assert written
        for one in written:
            assert isinstance(one.output, QueryResult)
            assert (one.output.window_us - frames[0].time_us + 700_000) % 2_000_000 == 0


@pytest.mark.parametrize("shrink", [0, 1, 2048])
@pytest.mark.parametrize(
    ("name", "threshold"), [("syn_flood", 4), ("incomplete_flows", 4), ("slowloris", 90)]
)
def test_differences_are_read_at_the_end_of_the_window(name, threshold, shrink, everything):
    """Exact, also for keys without a cell, with candidates and their cells as the only tuples."""
    key = f"{PREFIX}.{name}:threshold={threshold},window=2s"
    found, tuples = play([key], everything, size=64, shrink=shrink)
    results = found[next(iter(found))]
    same(rows(results), expect(name, everything, {"threshold": threshold, "window": 2000}))
    assert all(result.exact for result in results)
    if not shrink:
        assert tuples < len(everything) / 15


def test_short_windows_of_differences_are_exact(everything):
    """The switch counts them from its own beginning: since 1970 they would not fit into its window numbers."""
    began_us = everything[0].time_us // 1_000_000 * 1_000_000
    found, tuples = play([f"{PREFIX}.syn_flood:window=200ms"], everything, size=32, base_us=began_us)
    (results,) = found.values()
    same(rows(results), expect("syn_flood", everything, {"window": 200}))
    assert tuples < len(everything) / 2, "counted in the switch"


def test_what_a_killed_adapter_left_is_taken_out():
    """Entries that came and went are no matter; those that stayed are deleted."""
    control, switch = Control(CATALOGUE), SwitchModel()
    said = [control.want([f"{PREFIX}.ddos"]), control.want([f"{PREFIX}.ddos", f"{PREFIX}.new_tcp"])]
    for changes in said:
        switch.change(changes)
    sweep = leftovers(changes.updates for changes in said)
    assert sweep
    switch.change(ControllerUpdates(updates=sweep))
    assert not any(switch.stages)
