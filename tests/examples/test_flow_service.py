"""The collector as an app: real UDP datagrams in, record batches and states out."""

import socket
from contextlib import ExitStack

import flow_records.service as flow_records
import pytest
from flow_records.columns import FLOW_COLUMNS, read_flows
from flow_records.datagram_queue import Datagram, DatagramQueue
from flow_records.settings import Settings, segment_of
from flow_records.udp_listener import UdpListener

from due.errors import InvalidOption
from sdnator.testing import AppRun, wait_for
from tests.examples.flow_datagrams import (
    EXPORT_S,
    flow_sample,
    flow_set,
    ipfix,
    netflow5,
    netflow9,
    raw_header,
    sflow5,
    template,
    v5_record,
)

FLOWS = "network.flows.flow_records"
STATE = "network.exporter.flow_records"
LAB, OTHER, STRANGER = "127.0.0.1", "127.0.0.2", "127.0.0.3"
ONE = flow_set(0, template(256, (8, 4), (2, 4))), flow_set(256, bytes([192, 0, 2, 1, 0, 0, 0, 7]))


@pytest.fixture
def send():
    """Sends a datagram to an app's first port, from an address of this machine."""
    with ExitStack() as stack:
        sockets = {}
        for address in (LAB, OTHER, STRANGER):
            sockets[address] = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            sockets[address].bind((address, 0))

        def send(app, *datagrams, source=LAB):
            host, port = app.service.ready()["listening"].split()[0].rsplit(":", 1)
            for datagram in datagrams:
                sockets[source].sendto(datagram, (host, int(port)))

        yield send


def collector(**settings):
    chosen = {"ports": [0], "exporters": {"lab": LAB, "other": OTHER}} | settings
    return AppRun(flow_records, app_id="flow_records", **chosen)


def test_flows_of_all_protocols_come_out_under_their_exporter(send):
    """On one port, with the time of the export as event time."""
    with collector() as app:
        send(app, netflow5(v5_record()))
        (item,) = app.wait_for(f"{FLOWS}.lab")
        assert item.event_time == EXPORT_S * 10**9
        assert item.value.columns == tuple(FLOW_COLUMNS)
        assert read_flows(item.value)["packets"].tolist() == [3]
        send(app, netflow9(*ONE), source=OTHER)
        (item,) = app.wait_for(f"{FLOWS}.other")
        assert item.value["packets"].tolist() == [7]
        send(app, ipfix(flow_set(2, template(256, (8, 4), (2, 4))), ONE[1]))
        send(app, sflow5(flow_sample(raw_header(bytes(60)), rate=9)))
        wait_for(lambda: app.health()["records"] == 4, why=app.health)
        (lab, other) = app.health()["exporters"]
        assert (lab["name"], lab["protocols"]) == ("lab", ["ipfix", "netflow5", "sflow5"])
        assert (other["name"], other["protocols"]) == ("other", ["netflow9"])


def test_only_listed_exporters_are_accepted(send):
    with collector() as app:
        send(app, netflow5(v5_record()), source=STRANGER)
        wait_for(lambda: app.health()["not_listed"] == 1)
        send(app, netflow5(v5_record()))
        app.wait_for(f"{FLOWS}.lab")
        assert app.written(f"{FLOWS}.*")[0].key == f"{FLOWS}.lab"
        assert [one["name"] for one in app.health()["exporters"]] == ["lab"]


def test_any_exporter_is_accepted_on_demand_under_its_address(send):
    with collector(exporters={}, any_exporter=True) as app:
        send(app, netflow5(v5_record()), source=STRANGER)
        (item,) = app.wait_for(f"{FLOWS}.*")
        assert item.key == f"{FLOWS}.127_0_0_3"


def test_without_exporters_it_runs_and_listens_to_nobody():
    """Installed and not configured: it must neither keep a pipeline from starting nor take ports."""
    with collector(exporters={}) as app:
        assert app.health()["listening"] == []
        assert app.service.ready() == {"listening": ""}


def test_losses_and_refusals_are_shown(send):
    """In the state of the exporter and in the sums of the app's health."""
    with collector() as app:
        send(app, netflow5(v5_record(), sequence=10), netflow5(v5_record(), sequence=15), b"rubbish")
        wait_for(lambda: app.health()["refused"] == 1, why=app.health)
        assert app.health()["lost_records"] == 4
        wait_for(lambda: any(item.value["refused"] for item in app.written(f"{STATE}.lab")))
        state = app.written(f"{STATE}.lab")[-1].value
        assert (state["lost_records"], state["records"], state["refused_by_cause"]) == (4, 2, {"version": 1})


def test_sampling_of_the_settings_is_for_exporters_that_tell_none(send):
    with collector(sampling={"lab": 100}) as app:
        send(app, netflow5(v5_record()))
        (item,) = app.wait_for(f"{FLOWS}.lab")
        assert item.value["packets"].tolist() == [300]


@pytest.mark.parametrize("archive", [False, True])
def test_records_are_archived_if_the_settings_say_so(send, archive):
    with collector(archive=archive) as app:
        send(app, netflow5(v5_record()))
        app.wait_for(f"{FLOWS}.lab")
        app.service._engine.flush()
        assert len(app.archived(f"{FLOWS}.lab")) == archive


def test_datagrams_of_one_tick_leave_as_one_item(send):
    with collector() as app:
        send(app, *[netflow5(*[v5_record()] * 30, sequence=30 * place) for place in range(100)])
        wait_for(lambda: sum(len(item.value) for item in app.written(f"{FLOWS}.lab")) == 3000, why=app.health)
        assert len(app.written(f"{FLOWS}.lab")) < 100


def test_a_taken_port_is_named(send):
    with collector() as app:
        port = int(app.service.ready()["listening"].rsplit(":", 1)[1])
        with (
            pytest.raises(InvalidOption, match=f"listen on 127.0.0.1 port {port}"),
            collector(ports=[0, port]),
        ):
            pass


def test_ipv4_exporters_are_known_at_a_socket_for_both_versions():
    """There they are ::ffff:192.0.2.1."""
    seen = []
    queue = DatagramQueue(10)
    listener = UdpListener("::", [0], lambda address: seen.append(address) or "lab", queue)
    try:
        port = int(listener.addresses[0].rsplit(":", 1)[1])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.sendto(b"hello", (LAB, port))
        wait_for(lambda: len(queue))
    finally:
        listener.close()
    (datagram,) = queue.take(10)
    assert (datagram.exporter, datagram.content, seen) == ("lab", b"hello", [LAB])


def test_the_queue_is_bounded_in_number_and_in_bytes():
    queue = DatagramQueue(3, most_bytes=10)
    for content in (b"1234", b"12345678", b"123", b"123", b""):
        queue.put(Datagram("lab", 1, 0, content))
    assert [each.content for each in queue.take(2)] == [b"1234", b"123"]
    assert (queue.dropped, len(queue)) == (2, 1)
    queue.put(Datagram("lab", 1, 0, b"1234567"))
    assert [each.content for each in queue.take(9)] == [b"123", b"1234567"]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"ports": ()}, "ports"),
        ({"ports": (70_000,)}, "ports"),
        ({"listen": "everywhere"}, "listen='everywhere'"),
        ({"exporters": {"a.b": LAB}}, "'a.b' is no name"),
        ({"exporters": {"lab": "router"}}, "exporters.lab='router'"),
        ({"exporters": {"a": "::1", "b": "0:0::1"}}, "same address"),
        (
            {"exporters": {f"e{place}": f"10.0.{place // 250}.{place % 250}" for place in range(257)}},
            "256 at most",
        ),
        ({"sampling": {"lab": 0}}, "sampling.lab=0"),
        ({"template_s": float("nan")}, "template_s"),
        ({"queue": 0}, "queue=0"),
    ],
)
def test_wrong_settings_are_named(wrong, words):
    with pytest.raises(ValueError, match=words):
        Settings(**wrong)


def test_addresses_are_segments_of_keys():
    assert [segment_of(address) for address in ("192.0.2.1", "2001:db8::1")] == ["192_0_2_1", "2001-db8--1"]
