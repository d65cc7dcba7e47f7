"""Windows: late and disordered packets, bounded memory, queries that come and go."""

import random
from typing import Any

import numpy as np
import pytest

from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.query.language import SYN, Query, count, field, ip, largest, length, tcp
from apps.sonata_adapter.query.language import udp as own
from apps.sonata_adapter.results import Captured
from sdnator.testing.query_traffic import BASE_US, TimedFrame, batch_of, batches, mixed, office, udp
from sdnator.testing.query_traffic import tcp as tcp_frame


def run(engine, frames, size=100_000):
    """All outputs of batches of this size."""
    found: list[Any] = []
    for batch in batches(frames, size):
        found += engine.process(batch)
    return found


def syns(times_ms, dst="10.0.0.1"):
    return [TimedFrame(BASE_US + t * 1000, 60, tcp_frame("10.1.1.1", dst, 1000, 80, 2)) for t in times_ms]


def counting(threshold=2, window_ms=1000):
    query = Query("q", window_ms).filter(tcp.flags == SYN).map(dst=ip.dst)
    return query.reduce("dst", count=count()).filter(field("count") >= threshold)


def final(window_ms=1000):
    """A query whose results are known at the end of a window only."""
    query = Query("end", window_ms).filter(tcp.flags == SYN).map(dst=ip.dst, length=length)
    return query.reduce("dst", longest=largest(field("length")))


def test_out_of_order_packets_count_while_their_window_is_open():
    """A window stays open for the lateness; what comes later is left out and counted."""
    engine = HostEngine(lateness_us=300_000)
    engine.add(final())
    assert not run(engine, (syns([100, 900, 1200])))
    assert not run(engine, (syns([950])))
    closed = run(engine, (syns([1400])))
    assert [(r.window_us - BASE_US, r.at_us - BASE_US) for r in closed] == [(0, 1_000_000)]
    assert not run(engine, (syns([980])))
    assert engine.late == 1
    assert len(engine.finish()) == 1


def test_lateness_is_at_most_a_quarter_of_a_window():
    """Results of a window's end come soon after it, however short the window is."""
    engine = HostEngine(lateness_us=10_000_000)
    engine.add(final())
    run(engine, (syns([100])))
    assert not engine.advance(BASE_US + 1_249_999)
    assert len(engine.advance(BASE_US + 1_250_000)) == 1


def test_a_key_is_reported_once_in_a_window_at_its_crossing():
    """In batches of any size."""
    for size in (1, 2, 100):
        engine = HostEngine()
        engine.add(counting(3))
        found = run(engine, syns([10, 20, 30, 40, 50, 1100, 1200, 1300]), size)
        assert [r.at_us - BASE_US for r in found] == [30_000, 1_300_000]
        assert [r.fields["count"] for r in found] == [3, 3]


def test_beyond_the_bound_results_are_estimates_that_miss_nothing():
    """Ten thousand keys with room for a hundred: every key over the threshold is still reported."""
    rng = random.Random(2)
    hosts = [f"10.{n // 250}.{n % 250}.1" for n in range(3000)]
    heavy = hosts[-5:]
    frames = [f for host in hosts for f in syns([1], host)]
    frames += [f for host in heavy for f in syns([2] * 60, host)]
    rng.shuffle(frames)
    engine = HostEngine(limit=500)
    engine.add(counting(50))
    found = run(engine, frames, 512)
    assert set(heavy) <= {r.fields["dst"] for r in found}
    assert any("beyond the bound of 500" in r.error for r in found if not r.exact)
    assert all(r.exact == (not r.error) for r in found)


def test_distinct_beyond_the_bound_says_how_much_it_may_miss():
    """The Bloom filter lets nearly all new tuples pass."""
    frames = [
        TimedFrame(BASE_US, 60, udp("10.0.0.9", f"10.{n // 250}.{n % 250}.2", 1, 2)) for n in range(2000)
    ]
    engine = HostEngine(limit=1000)
    engine.add(CATALOGUE["superspreader"].query({"threshold": 1950}))
    found = run(engine, frames, 256)
    assert [r.fields["src"] for r in found] == ["10.0.0.9"]
    assert "missed" in found[0].error


def test_a_query_that_comes_within_a_window_says_so():
    """Its first window is partial, the next is not."""
    engine = HostEngine()
    engine.add(final(2000))
    run(engine, (syns([10])))
    engine.add(counting(1))
    found = run(engine, (syns([300, 1300])))
    assert [r.partial for r in found] == [True, False]


def test_a_clock_that_is_set_back_begins_anew():
    """What is open of the wrong time is reported; right windows stay open, the first of them says that it is partial."""
    engine = HostEngine()
    engine.add(final())
    run(engine, syns([100]))
    (whole,) = run(engine, syns([86_400_100]))
    (wrong,) = engine.set_back(BASE_US + 2_500_000)
    assert [(r.window_us - BASE_US) // 1_000_000 for r in (whole, wrong)] == [0, 86_400]
    found = run(engine, syns(range(2500, 6500, 100)), 1)
    assert [(r.window_us - BASE_US) // 1_000_000 for r in found] == [2, 3, 4, 5]
    assert [r.partial for r in found] == [True, False, False, False]
    assert engine.late == 0


def test_removing_a_query_forgets_it():
    """No result comes any more, and no state stays."""
    engine = HostEngine()
    engine.add(counting(1))
    engine.remove("q")
    assert not run(engine, (syns([10])))
    assert not engine.finish()
    assert not engine.names


def test_streams_report_packets_and_tuples():
    """Without a reduce a query passes packets on, or the fields that its map names."""
    engine = HostEngine()
    engine.add(Query("packets").filter(tcp.flags == SYN))
    engine.add(Query("tuples").filter(tcp.flags == SYN).map(dst=ip.dst, bytes=length))
    frames = sorted(office(2, random.Random(1)))
    found = run(engine, frames, 300)
    assert all(isinstance(r, Captured) for r in found)
    packets = [r.batch for r in found if r.query == "packets"]
    tuples = [r.batch for r in found if r.query == "tuples"]
    assert sum(map(len, packets)) == sum(map(len, tuples)) > 0
    assert set(tuples[0].columns) == {"time_us", "dst_hi", "dst_lo", "bytes"}
    assert all(((batch["tcp_flags"] & 0x17) == 2).all() for batch in packets)


def test_distinct_alone_reports_each_new_tuple():
    """In every window anew."""
    engine = HostEngine()
    engine.add(Query("talkers", 1000).map(src=ip.src).distinct())
    found = run(engine, (syns([1, 2, 3, 1001])))
    assert [(r.at_us - BASE_US, r.fields) for r in found] == [
        (1000, {"src": "10.1.1.1"}),
        (1_001_000, {"src": "10.1.1.1"}),
    ]


@pytest.mark.parametrize("name", ["dns_tunnel", "zorro"])
def test_missing_bytes_are_counted(name):
    """Headers alone cannot answer a query on payload: the engine says how many packets it could not read."""
    frames = [TimedFrame(BASE_US, 90, udp("10.0.0.1", "10.0.0.2", 53, 5000, bytes(40)))]
    frames += [TimedFrame(BASE_US, 90, tcp_frame("10.0.0.1", "10.0.0.2", 5000, 23, 24, b"zorro"))]
    whole = batch_of(frames)
    headers = type(whole)({n: whole[n] for n in whole.columns if n not in ("frame", "captured")})
    engine = HostEngine()
    engine.add(CATALOGUE[name].query({"gate": 1}))
    engine.process(headers)
    assert engine.without_payload == 1
    assert np.array_equal(headers["length"], whole["length"])


def outputs(queries, frames, size=700, changes=()):
    """Results by query; `changes` are called with the engine after so many batches."""
    engine = HostEngine()
    for query in queries:
        engine.add(query)
    found = []
    for number, batch in enumerate(batches(frames, size)):
        for at, change in changes:
            if at == number:
                change(engine)
        found += engine.process(batch)
    return sorted(str(each) for each in found + engine.finish())


def test_queries_together_find_what_each_finds_alone():
    """They share columns, keys and flows: in small batches and in large ones, disordered ones too."""
    rng = random.Random(5)
    frames = mixed(CATALOGUE, seconds=12)
    near = sorted(frames, key=lambda frame: frame.time_us + rng.randrange(300_000))
    queries = [template.query() for template in CATALOGUE.values()]
    queries += [counting(5, 700)]
    for order, size in ((frames, 20_000), (near, 700)):
        alone = [text for query in queries for text in outputs([query], order, size)]
        assert outputs(queries, order, size) == sorted(alone)


def test_queries_that_come_and_go_do_not_disturb_the_others():
    """What the others find is the same, whoever shares their work for a while."""
    frames = mixed(CATALOGUE, seconds=12)
    stay = [CATALOGUE[name].query() for name in ("superspreader", "slowloris", "syn_flood")]
    changes = [
        (2, lambda engine: engine.add(counting(1))),
        (3, lambda engine: engine.add(CATALOGUE["ddos"].query({"threshold": 1}))),
        (5, lambda engine: engine.remove("ddos")),
        (6, lambda engine: engine.remove("q")),
    ]
    names = {query.name for query in stay}
    kept = [text for text in outputs(stay, frames, 300, changes) if text.split("'")[1] in names]
    assert kept == outputs(stay, frames, 300)


def test_a_query_that_comes_sees_flows_that_others_have_seen_before():
    """The first packets of the flows were before its time; the next ones count."""
    frames = [
        TimedFrame(BASE_US + t * 1000, 60, udp("10.0.0.9", f"10.0.1.{n}", 1, 2))
        for t in (10, 20)
        for n in range(50)
    ]
    later = Query("later", 3000).map(src=ip.src, dst=ip.dst, port=own.dport).distinct()
    engine = HostEngine()
    engine.add(CATALOGUE["superspreader"].query())
    run(engine, frames[:50])
    engine.add(later)
    found = run(engine, frames[50:])
    assert [r.query for r in found] == ["later"] * 50


def test_tables_are_complete_from_the_next_window_on():
    """A query that needs the tuples of a distinct comes when others already share it without them."""
    pairs = Query("crossing", 1000).map(src=ip.src, dst=ip.dst).distinct()
    table = pairs.reduce("dst", count=count())
    frames = syns([10, 400, 1100, 1300]) + syns([1400], "10.0.0.2")
    alone, shared = HostEngine(), HostEngine()
    whole = Query("whole", 1000).map(src=ip.src, dst=ip.dst).distinct().join(table, "dst")
    shared.add(pairs.reduce("dst", count=count()).filter(field("count") >= 1))
    run(shared, frames[:1])
    for engine, rest in ((alone, frames), (shared, frames[1:])):
        engine.add(whole)
        found = [one for one in run(engine, rest, 1) + engine.finish() if one.query == "whole"]
        last = [one.fields for one in found if one.window_us == BASE_US + 1_000_000]
        assert sorted(one["dst"] for one in last) == ["10.0.0.1", "10.0.0.2"]
        assert [one.partial for one in found[-2:]] == [False, False]
