"""What the adapter has the product's program count, on the embedded switch."""

import numpy as np
import pytest

from apps.sonata_adapter.control import Control
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.results import QueryResult
from dataplane.compiler.c_machine import CMachine
from dataplane.v1model.tables import TableEntry, Ternary
from due import RecordBatch
from sdnator.testing.query_traffic import BASE_US, TimedFrame, batch_of, tcp
from tests.apps.sonata_adapter.switch.test_register_reads import HALF_OPEN, OWN
from tests.apps.sonata_adapter.switch_model import counts_of, matches
from tests.dataplane.loading import sdnator
from tests.p4.counting_switch import ask
from tests.p4.sdnator_switch import made

SYN, SYN_ACK, ACK = 0x02, 0x12, 0x10
_COUNT = ("query", "window", "count", "source", "destination", "port", "length", "source_port", "time_us")


class Network:
    """A switch with the adapter's counting entries; the classifier's verdict is set frame by frame."""

    def __init__(self, key):
        self.switch = made(sdnator(), CMachine)
        self.control = Control({**CATALOGUE, **OWN})
        self.control.switch("s1", BASE_US)
        changes = self.control.want([key])
        self.offers = changes.offer
        for update in changes.updates:
            self._insert(update)
        self.written = []

    def _insert(self, update):
        table = self.switch.tables[update.table]
        spec = next(each for each in table.spec.actions if each.name == update.action)
        numbers = tuple(int(update.params[param.name], 16) for param in spec.params)
        assert len(numbers) == len(update.params)
        match = (Ternary(*(int(text, 16) for text in update.match["query_map"])),)
        table.insert(TableEntry(match, spec.name, numbers, priority=update.priority))

    def play(self, frame, now):
        """One frame; what the switch reports is taken by the adapter, its questions are answered."""
        batch = batch_of([frame])
        packet = {name: batch[name][0] for name in batch.columns}
        bits = sum(1 << offer["bit"] for offer in self.offers if matches(offer["conditions"], packet))
        for name in ("link", "src", "dst", "l4", "sport", "dport"):
            self.switch.tables[f"ingress.telemetry_{name}"].set_default(f"ingress.match_{name}", (bits,))
        self.switch.tables["ingress.telemetry_active"].set_default("ingress.set_active", (bits, 0, 0))
        data = frame.data.ljust(frame.length, b"\0")
        for digest in self.switch.process(1, data, frame.time_us - BASE_US).digests:
            self._take(digest, batch, now)
        for read in self.control.reads(now).get("s1", ()):
            self._answer(read)
        self.written += self.control.tick(now)

    def _take(self, digest, batch, now):
        if digest.name == "count_digest_t":
            told = dict(zip(_COUNT, (int(value) for value in digest.values), strict=True))
            told["time_us"] += BASE_US
            self.written += self.control.counts("s1", f"q{told['query']}", counts_of([told]), now)
            return
        _, crossed, overflow = (int(value) for value in digest.values[:3])
        for bit in range(256):
            if (crossed | overflow) >> bit & 1:
                flags = {
                    "crossed": np.array([crossed >> bit & 1]),
                    "overflow": np.array([overflow >> bit & 1]),
                }
                self.written += self.control.digests("s1", f"q{bit}", RecordBatch({**batch, **flags}))

    def _answer(self, read):
        if read.sweep:
            return
        answer = ask(
            self.switch, query=read.bit, source=read.source, destination=read.destination, port=read.port,
            length=read.length, source_port=read.source_port, timestamp=read.time_us - BASE_US,
        )  # fmt: skip
        self.written += self.control.cells("s1", [read.id], [answer.count])


@pytest.fixture(params=["network.traffic_query.sonata.syn_flood", HALF_OPEN])
def network(request):
    found = Network(request.param)
    yield found
    found.switch.close()


def segments(second, number, flags, *, back=False):
    ends = ("192.0.2.1", "10.0.0.9") if back else ("10.0.0.9", "192.0.2.1")
    return [
        TimedFrame(BASE_US + round(second * 1e6) + n, 60, tcp(*ends, 1000 + n, 80, flags))
        for n in range(number)
    ]


def test_counts_of_a_window_are_known_when_it_is_over(network):
    """SYNs + SYN-ACKs - ACKs of two windows, in one cell or in three that are read: the same results."""
    frames = [*segments(0.5, 9, SYN), *segments(0.6, 8, SYN_ACK, back=True), *segments(0.7, 6, ACK)]
    frames += [*segments(3.5, 5, SYN), *segments(4.5, 1, ACK), *segments(6.5, 2, ACK)]
    for number, frame in enumerate(frames):
        network.play(frame, number / 10)
    network.written += network.control.tick(len(frames))
    results = [one.output for one in network.written]
    assert all(isinstance(each, QueryResult) for each in results)
    assert [(each.fields["count"], each.exact) for each in results] == [(11, True), (4, True)]
