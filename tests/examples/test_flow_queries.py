"""Sonata queries over flow records: what they find in packets they find in the flows of these packets."""

import random

import flow_records.flow_queries.service as flow_queries
import numpy as np
import pytest
from flow_records.columns import FLOW_COLUMNS
from flow_records.flow_queries.query_windows import MOST_QUERIES, RESULTS, QueryWindows
from flow_records.packet_rows import packet_groups, single_packets
from hypothesis import given
from hypothesis import strategies as st

from apps.packets import PACKET_COLUMNS, read_columns
from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.query.catalogue import CATALOGUE
from due import RecordBatch
from due.errors import InvalidOption
from sdnator.testing import AppRun, wait_for
from sdnator.testing.query_traffic import BASE_US, HOSTS, TimedFrame, attack, batch_of, mixed, office, tcp
from tests.examples.flow_datagrams import flows_of

FIN, SYN, RST, PSH, ACK = 1, 2, 4, 8, 16
NEED_PAYLOAD = {"dns_tunnel", "zorro", "dns_reflection", "arp_scan"}
ANSWERED = sorted(CATALOGUE.keys() - NEED_PAYLOAD)
DELAY_US = 75_000_000


def windows(*queries, most=1 << 16):
    found = QueryWindows(DELAY_US, most)
    assert found.want([f"{RESULTS}.{query}" for query in queries], CATALOGUE) == {}
    return found


def fields(results):
    return sorted((sorted(found.result.fields.items()), found.result.window_us) for found in results)


def flow(**given):
    """One record of a TCP flow."""
    columns = {
        "time_us": BASE_US,
        "first_us": BASE_US - 1_000_000,
        "last_us": BASE_US,
        "ip_version": 4,
        "ip_proto": 6,
    }
    columns |= {"ip_src_lo": 1, "ip_dst_lo": 2, "src_port": 40_000, "dst_port": 443, "sampling": 1} | given
    values = {name: columns.get(name, -1 if kind[0] == "i" else 0) for name, kind in FLOW_COLUMNS.items()}
    return RecordBatch({name: np.array([values[name]], dtype=kind) for name, kind in FLOW_COLUMNS.items()})


def syns(count, begin_us=BASE_US):
    """Connections of many hosts to one."""
    return [
        TimedFrame(begin_us + place, 60, tcp(f"10.7.0.{place}", "192.0.2.9", 5000, 80, SYN))
        for place in range(count)
    ]


def groups(**given):
    """Flags and number of the packets that a flow stands for."""
    found = packet_groups(flow(**given))
    return list(zip(found["tcp_flags"].tolist(), found["packets"].tolist(), strict=True))


def test_a_flow_is_a_syn_a_fin_and_the_rest():
    whole = {"packets": 10, "bytes": 1005, "tcp_flags": FIN | SYN | PSH | ACK}
    assert groups(**whole) == [(SYN, 1), (FIN | ACK, 1), (PSH | ACK, 8)]
    found = packet_groups(flow(**whole))
    assert found["time_us"].tolist() == [BASE_US - 1_000_000, BASE_US, BASE_US - 1_000_000]
    assert found["last_us"].tolist() == [BASE_US - 1_000_000, BASE_US, BASE_US]
    assert found["bytes"].sum() == 1005
    assert set(found["length"].tolist()) == {100}


def test_the_side_with_the_lower_port_answered():
    assert groups(packets=2, tcp_flags=SYN | PSH | ACK, src_port=443, dst_port=40_000) == [
        (SYN | ACK, 1),
        (PSH | ACK, 1),
    ]


@pytest.mark.parametrize("flags", [SYN, ACK, RST, PSH | ACK, 0])
def test_packets_of_one_kind_stay_of_one_kind(flags):
    """A SYN that is repeated stays a SYN, for one."""
    assert groups(packets=5, tcp_flags=flags) == [(flags, 5)]


def test_syn_acks_that_nobody_acknowledges_stay_syn_acks():
    """What a flooded server sends."""
    assert groups(packets=5, tcp_flags=SYN | ACK, src_port=443, dst_port=40_000) == [(SYN | ACK, 5)]


def test_a_flow_of_one_packet_has_its_flags():
    assert groups(packets=1, tcp_flags=SYN | ACK) == [(SYN | ACK, 1)]
    assert groups(packets=100, sampling=100, tcp_flags=SYN | ACK) == [(SYN | ACK, 100)]


def test_a_syn_among_sampled_packets_stands_for_many():
    assert groups(packets=1000, sampling=100, tcp_flags=SYN | ACK) == [(SYN, 100), (ACK, 900)]


def test_flags_outnumber_packets():
    """Exporters may be wrong: no packet is made up."""
    assert groups(packets=2, tcp_flags=FIN | SYN | RST | ACK) == [(SYN, 1), (FIN | ACK, 1)]


def test_other_protocols_keep_ports_and_types_where_packets_have_them():
    found = packet_groups(flow(ip_proto=17, src_port=53, dst_port=5353, packets=4, tcp_flags=0, input=7))
    assert [int(found[name][0]) for name in ("udp_sport", "udp_dport", "tcp_sport", "port")] == [
        53,
        5353,
        -1,
        7,
    ]
    found = packet_groups(
        flow(ip_proto=58, ip_version=6, icmp_type=128, icmp_code=0, packets=4, src_port=-1, dst_port=-1)
    )
    assert [int(found[name][0]) for name in ("icmp6_type", "icmp6_code", "icmp_type", "eth_type")] == [
        *(128, 0, -1, 0x86DD)
    ]


COUNTS = st.integers(0, 1 << 50)
FLOWS = st.lists(
    st.fixed_dictionaries(
        {
            "packets": st.integers(0, 40) | COUNTS,
            "bytes": COUNTS,
            "sampling": st.integers(1, 5) | st.integers(1, 1 << 20),
            "tcp_flags": st.integers(0, 255),
            "ip_proto": st.sampled_from([-1, 1, 6, 6, 6, 17, 58]),
            "ip_version": st.sampled_from([0, 4, 6]),
            "src_port": st.integers(-1, 65_535),
            "first_us": st.integers(0, BASE_US),
        }
    ),
    max_size=5,
)


@given(FLOWS, st.integers(1, 200))
def test_no_packet_and_no_byte_is_made_up_or_lost(given_flows, most):
    """Groups hold all packets and bytes; rows never exceed the limit by more than a row a group, nor lose bytes."""
    if not given_flows:
        return
    parts = [flow(**each) for each in given_flows]
    flows = RecordBatch({name: np.concatenate([part[name] for part in parts]) for name in FLOW_COLUMNS})
    found = packet_groups(flows)
    assert found["packets"].sum() == np.maximum(flows["packets"], 1).sum()
    assert found["bytes"].sum() == flows["bytes"].sum()
    assert found["packets"].min() >= 1
    packets = single_packets(found, most)
    assert read_columns(packets, PACKET_COLUMNS, "packets") == packets
    assert len(packets) <= min(int(found["packets"].sum()), most + len(found))
    assert np.all(np.diff(packets["time_us"]) >= 0)
    assert packets["time_us"].min() >= flows["first_us"].min()
    assert packets["time_us"].max() <= flows["last_us"].max()
    if flows["bytes"].max() < 1 << 32:
        assert packets["length"].sum(dtype=np.uint64) == flows["bytes"].sum()


@pytest.mark.parametrize("name", ANSWERED)
def test_records_of_single_packets_give_the_results_of_packets(name):
    """As sFlow with a rate of 1 would: same hosts, counts and windows, whatever the order of arrival."""
    frames = [
        frame for frame in mixed(ANSWERED, seconds=12) if frame.data[12:14] in (b"\x08\x00", b"\x86\xdd")
    ]
    engine = HostEngine()
    query = CATALOGUE[name].query()
    engine.add(query)
    wanted = [*engine.process(batch_of(frames)), *engine.finish()]
    tried = windows(name)
    end_us = frames[-1].time_us
    found = []
    random.Random(5).shuffle(frames)
    for begin in range(0, len(frames), 500):
        part = frames[begin : begin + 500]
        records = [flows_of([frame], export_us=end_us) for frame in part]
        joined = RecordBatch(
            {column: np.concatenate([each[column] for each in records]) for column in FLOW_COLUMNS}
        )
        found += tried.take("lab", joined, 0.0)
    found += tried.finish()
    expected = sorted((sorted(result.fields.items()), result.window_us) for result in wanted)
    assert fields(found) == expected
    assert expected


@pytest.mark.parametrize("name", ANSWERED)
def test_attack_is_found_in_flows(name):
    """The flows of an attack and of a quiet office, each exported at its end: the query reports the host."""
    rng = random.Random(3)
    start = BASE_US + 60_000  # all within the window of three seconds that begins at BASE_US
    frames = sorted(office(4, rng) + attack(name, start, rng), key=lambda frame: frame.time_us)
    tried = windows(name)
    found = [*tried.take("lab", flows_of(frames), 0.0), *tried.finish()]
    hosts = {each.result.fields.get("src", each.result.fields.get("dst")) for each in found}
    assert HOSTS[name] in hosts


def test_a_threshold_is_told_at_once_and_a_difference_when_its_window_is_over():
    frames = syns(60)
    tried = windows("new_tcp", "syn_flood")
    flows = flows_of(frames, export_us=BASE_US + 10_000_000)
    at_once = tried.take("lab", flows, 100.0)
    assert {found.key.split(":")[0] for found in at_once} == {f"{RESULTS}.new_tcp"}
    assert tried.advance(100.0 + 65.0) == []
    (over,) = tried.advance(100.0 + 69.0)
    assert over.key.startswith(f"{RESULTS}.syn_flood:")
    assert over.to_value()["exporter"] == "lab"
    assert (over.result.fields["dst"], over.result.fields["count"]) == ("192.0.2.9", 60)


def test_exporters_are_counted_apart():
    """Two routers on one path tell the same packets twice."""
    frames = syns(30)
    tried = windows("new_tcp:threshold=40")
    flows = flows_of(frames)
    assert [*tried.take("a", flows, 0.0), *tried.take("b", flows, 0.0), *tried.finish()] == []


def test_records_of_a_wrong_clock_stop_nothing():
    """One export from the year 2100 does not close the windows of all others."""
    frames = syns(60)
    tried = windows("new_tcp")
    tried.take("lab", flows_of(frames[:20]), 0.0)
    assert tried.take("lab", flows_of(frames[20:30], export_us=4_102_444_800_000_000), 0.0) == []
    assert tried.take("lab", flows_of(frames[20:]), 0.0) != []
    assert tried.health()["times_doubted"] >= 1


def test_a_clock_that_was_ahead_is_followed_when_it_is_set_right():
    """The exporter sends twenty times by then, so that nobody sets it back with one record."""
    tried = windows("new_tcp")
    ahead_us = BASE_US + 7_200_000_000
    assert tried.take("lab", flows_of(syns(60, ahead_us)), 0.0) != []
    for second in range(20):
        begin_us = BASE_US + second * 1_000_000
        tried.take("lab", flows_of(syns(1, begin_us), export_us=begin_us), 0.0)
    connections = syns(60, BASE_US + 60_000_000)
    assert tried.take("lab", flows_of(connections[:30]), 0.0) == []
    assert tried.take("lab", flows_of(connections[30:]), 0.0) != []
    health = tried.health()
    assert (health["late"], health["clocks_set_back"]) == (0, 1)


def test_packets_of_long_ago_count_in_the_oldest_open_window():
    """A record whose flow began before `delay_us` is cut there, so that it is not late."""
    tried = windows("superspreader:threshold=1")
    old = flow(time_us=BASE_US, first_us=BASE_US - 10 * DELAY_US, last_us=BASE_US, packets=2, tcp_flags=ACK)
    assert len(tried.take("lab", old, 0.0)) >= 1
    assert tried.health()["late"] == 0


def test_packets_beyond_the_limit_are_counted():
    tried = windows("superspreader:threshold=1", most=100)
    tried.take("lab", flow(packets=1_000, tcp_flags=ACK), 0.0)
    assert tried.health()["left_out"] == 900


@pytest.mark.parametrize("name", sorted(NEED_PAYLOAD))
def test_queries_about_what_flows_do_not_tell_are_refused(name):
    (reason,) = QueryWindows(DELAY_US, 100).want([f"{RESULTS}.{name}"], CATALOGUE).values()
    assert "flow records do not tell" in reason


@pytest.mark.parametrize(
    ("key", "words"),
    [
        (f"{RESULTS}.new_tpc", "there is no query new_tpc"),
        (f"{RESULTS}.new_tcp:threshold=many", "threshold"),
        (f"{RESULTS}.new_tcp:threshold=auto", "only a running adapter learns thresholds"),
        (f"{RESULTS}.a.b", "flow_queries"),
        ("network.traffic_query.sonata.new_tcp", "not a key of flow_queries"),
    ],
)
def test_wrong_keys_are_refused_with_what_would_do(key, words):
    (reason,) = QueryWindows(DELAY_US, 100).want([key], CATALOGUE).values()
    assert words in reason
    assert "sonata" not in reason.replace(key, "")


def test_the_number_of_queries_is_limited():
    keys = [f"{RESULTS}.new_tcp:threshold={number}" for number in range(1, MOST_QUERIES + 3)]
    assert len(QueryWindows(DELAY_US, 100).want(keys, CATALOGUE)) == 2


def test_the_app_answers_queries_of_its_settings():
    """Flows in under the collector's key, results out and archived."""
    frames = syns(60)
    with AppRun(flow_queries, queries=["new_tcp:threshold=50"]) as app:
        app.feed("network.flows.flow_records.lab", flows_of(frames))
        (item,) = app.wait_for(f"{RESULTS}.new_tcp")
        assert item.key == f"{RESULTS}.new_tcp:dst=any,refine=none,threshold=50,window=3s"
        assert (item.value["dst"], item.value["count"], item.value["exporter"]) == ("192.0.2.9", 50, "lab")
        wait_for(lambda: app.archived(f"{RESULTS}.new_tcp"))
        app.feed("network.flows.flow_records.lab", {"rubbish": 1})
        wait_for(lambda: app.health()["refused_messages"] == 1)
        assert app.health()["results"] == 1


def test_a_query_of_the_settings_that_cannot_run_is_named():
    with (
        pytest.raises(InvalidOption, match="flow records do not tell"),
        AppRun(flow_queries, queries=["zorro"]),
    ):
        pass


@pytest.mark.parametrize(
    ("name", "wrong"), [("delay_s", -1.0), ("delay_s", float("nan")), ("most_packets", 0)]
)
def test_wrong_settings_are_named(name, wrong):
    with pytest.raises(ValueError, match=name):
        flow_queries.Settings(**{name: wrong})
