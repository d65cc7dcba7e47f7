"""A window with fewer packets than a query needs reports nothing, whatever the packets are."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.query.dataflow import compile_query
from apps.sonata_adapter.query.least_packets import least_packets
from apps.sonata_adapter.query.text import parse_queries
from due import RecordBatch
from sdnator.testing.query_traffic import BASE_US, TimedFrame, batch_of
from sdnator.testing.query_traffic import tcp as tcp_frame

WANTED = {
    "new_tcp": 40,
    "superspreader": 40,
    "port_scan": 40,
    "ddos": 45,
    "arp_scan": 40,
    "ssh_brute_force": 40,
    "syn_flood": 2,
    "incomplete_flows": 1,
    "slowloris": 5,
    "dns_reflection": 1,
    "dns_tunnel": 1,
    "zorro": 1,
}


@pytest.mark.parametrize("name", sorted(WANTED))
def test_what_the_catalogues_queries_need(name):
    """Counts need their threshold; a packet may count as SYN and SYN-ACK of two hosts; payloads are always read."""
    assert least_packets(compile_query(CATALOGUE[name].query())) == WANTED[name]


@pytest.mark.parametrize(
    ("text", "least"),
    [
        ("reduce by src: n = sum(length)\n    filter n >= 500", 1),
        ("reduce by src: n = max(length)\n    filter n >= 500", 1),
        ("reduce by src: n = count()\n    filter n > 7 and n >= 3", 8),
        ("reduce by src: n = count()\n    map n = n + n + 2, src\n    filter n >= 12", 5),
        ("reduce by src: n = count()\n    map n = n * n, src\n    filter n >= 100", 1),
        ("reduce by src: n = count()\n    map n = 50 - n, src\n    filter n >= 40", 1),
    ],
)
def test_values_that_are_no_counts_have_no_bound(text, least):
    (template,) = parse_queries(f"query q(window=3s):\n    map src = ip.src, length\n    {text}\n")
    assert least_packets(compile_query(template.query())) == least


@given(
    packets=st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, 3), st.sampled_from([0x02, 0x12, 0x10, 0x11])),
        max_size=60,
    ),
    cuts=st.lists(st.integers(0, 60), max_size=5),
    threshold=st.integers(1, 30),
)
def test_holding_packets_back_changes_no_result(packets, cuts, threshold):
    """However a window's packets are cut into batches, results are those of a single batch."""
    frames = [
        TimedFrame(BASE_US + at, 60, tcp_frame(f"10.0.0.{a}", f"10.0.1.{b}", 1000, 80, flags))
        for at, (a, b, flags) in enumerate(packets)
    ]
    queries = [CATALOGUE[name].query({"threshold": threshold}) for name in ("syn_flood", "new_tcp", "ddos")]

    def results(batches: list[RecordBatch]):
        engine = HostEngine()
        for query in queries:
            engine.add(query)
        found = [one for batch in batches for one in engine.process(batch)]
        return sorted(repr((one.query, one.fields)) for one in [*found, *engine.finish()])

    edges = sorted({0, len(frames), *(cut for cut in cuts if cut < len(frames))})
    parts = [batch_of(frames[a:b]) for a, b in itertools.pairwise(edges)]
    assert results(parts) == results([batch_of(frames)] if frames else [])
