"""Drops are summed over entries that come, count and go; the switch here is a real gRPC server with made-up counters."""

from concurrent import futures

import grpc
import pytest

from p4rt import INSECURE, add_p4runtime_servicer, p4runtime
from sdnator.errors import PipelineError
from sdnator.replay.drop_counters import DropCounters


class Switch:
    """Answers reads of block entries from a dict: match value -> packets."""

    def __init__(self) -> None:
        self.counts: dict[int, int] = {}

    def GetForwardingPipelineConfig(self, request, context):  # noqa: ARG002
        reply = p4runtime.GetForwardingPipelineConfigResponse()
        for number, name in ((7, "ingress.block_mac"), (8, "ingress.forward_port")):
            preamble = reply.config.p4info.tables.add().preamble
            preamble.id, preamble.name = number, name
        return reply

    def Read(self, request, context):  # noqa: ARG002
        assert [entity.table_entry.table_id for entity in request.entities] == [7]
        reply = p4runtime.ReadResponse()
        for value, packets in self.counts.items():
            entry = reply.entities.add().table_entry
            entry.table_id = 7
            entry.match.add(field_id=1).exact.value = bytes([value])
            entry.counter_data.packet_count = packets
        yield reply

    def __getattr__(self, _):
        return lambda *_: None


@pytest.fixture
def switch():
    servicer = Switch()
    server = grpc.server(futures.ThreadPoolExecutor(1))
    add_p4runtime_servicer(servicer, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    servicer.address = f"127.0.0.1:{port}"
    yield servicer
    server.stop(None).wait()


def test_only_what_is_dropped_from_now_on_counts(switch):
    switch.counts = {1: 40}
    with DropCounters(switch.address, 1, INSECURE) as drops:
        assert drops.dropped() == 0
        switch.counts = {1: 43, 2: 5}
        assert drops.dropped() == 8


def test_entries_that_go_stay_counted_and_may_come_again(switch):
    with DropCounters(switch.address, 1, INSECURE) as drops:
        switch.counts = {1: 10}
        assert drops.dropped() == 10
        switch.counts = {}
        assert drops.dropped() == 10
        switch.counts = {1: 3}
        assert drops.dropped() == 13


def test_an_entry_made_anew_between_two_reads_begins_at_nothing(switch):
    with DropCounters(switch.address, 1, INSECURE) as drops:
        switch.counts = {1: 10}
        assert drops.dropped() == 10
        switch.counts = {1: 4}
        assert drops.dropped() == 14


def test_a_switch_that_is_away_is_named(switch):
    with pytest.raises(PipelineError, match=r"127\.0\.0\.1:1: UNAVAILABLE"):
        DropCounters("127.0.0.1:1", 1, INSECURE)
