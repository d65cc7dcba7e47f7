"""Counts that the adapter reads from the counting stages of the product's program, on the embedded switch."""

import numpy as np
import pytest

from apps.sonata_adapter.catalogue import CATALOGUE
from apps.sonata_adapter.control import Control
from dataplane.tables import Ternary
from due import RecordBatch
from tests.apps.sonata_adapter.switch_model import matches
from tests.apps.sonata_adapter.traffic import BASE_US, Frame, batch_of, tcp
from tests.dataplane.loading import sdnator
from tests.p4.sdnator_switch import entry, made
from tests.p4.test_counting import count_of

_SYN, _SYN_ACK, _ACK = 0x02, 0x12, 0x10
_PARAMETERS = (
    "query", "bit_of_query", "source_mask", "destination_mask", "port_mask", "length_mask", "threshold",
    "by_bytes", "reciprocal", "base", "size", "repeated", "source_port_mask",
)  # fmt: skip


class Cells:
    """The switch with the adapter's counting entries; the classifier's verdict is set frame by frame."""

    def __init__(self, switch, changes):
        self.switch = switch
        self.offers = changes.offer
        for update in changes.updates:
            numbers = [int(update.params[name], 16) for name in _PARAMETERS]
            match = (Ternary(*(int(text, 16) for text in update.match["query_map"])),)
            stage = update.table.split(".")[1]
            switch.tables[update.table].insert(
                entry(match, f"{stage}.count", *numbers, priority=update.priority)
            )

    def process(self, frame):
        """Which queries report the frame: (bit, crossed, overflow)."""
        batch = batch_of([frame])
        packet = {name: batch[name][0] for name in batch.columns}
        bits = sum(1 << offer["bit"] for offer in self.offers if matches(offer["conditions"], packet))
        for name in ("link", "src", "dst", "l4", "sport", "dport"):
            self.switch.tables[f"ingress.telemetry_{name}"].set_default(f"ingress.match_{name}", (bits,))
        self.switch.tables["ingress.telemetry_active"].set_default("ingress.set_active", (bits, 0, 0))
        result = self.switch.process(1, frame.data.ljust(frame.length, b"\0"), frame.time_us - BASE_US)
        for digest in result.digests:
            _, crossed, overflow = (int(value) for value in digest.values[:3])
            for bit in range(256):
                if (crossed | overflow) >> bit & 1:
                    yield bit, crossed >> bit & 1, overflow >> bit & 1

    def read(self, question):
        return count_of(
            self.switch, query=question.bit, source=question.source, destination=question.destination,
            port=question.port, length=question.length, source_port=question.source_port,
            timestamp=question.time_us - BASE_US,
        )  # fmt: skip


@pytest.fixture
def control():
    made_control = Control(CATALOGUE)
    made_control.switch("s1", BASE_US)
    return made_control


@pytest.fixture
def cells(control):
    switch = made(sdnator(), "auto")
    yield Cells(switch, control.want(["network.traffic_query.sonata.syn_flood"]))
    switch.close()


def segments(second, number, flags, *, back=False):
    ends = ("192.0.2.1", "10.0.0.9") if back else ("10.0.0.9", "192.0.2.1")
    return [
        Frame(BASE_US + round(second * 1e6) + n, 60, tcp(*ends, 1000 + n, 80, flags)) for n in range(number)
    ]


def test_counts_of_a_window_are_read_when_it_is_over(control, cells):
    """SYNs + SYN-ACKs - ACKs of two windows, each read while the next one counts in the other bank."""
    frames = [*segments(0.5, 9, _SYN), *segments(0.6, 8, _SYN_ACK, back=True), *segments(0.7, 6, _ACK)]
    frames += [*segments(3.5, 5, _SYN), *segments(4.5, 1, _ACK), *segments(6.5, 1, _ACK)]
    counts = []
    for now, frame in enumerate(frames):
        for bit, crossed, overflow in cells.process(frame):
            flags = {"crossed": np.array([crossed]), "overflow": np.array([overflow])}
            control.digests("s1", f"q{bit}", RecordBatch({**batch_of([frame]), **flags}))
        for reads in control.reads(now / 1000).values():
            answers = [cells.read(read) for read in reads]
            written = control.cells("s1", [read.id for read in reads], answers)
            counts += [(one.output.fields["count"], one.output.exact) for one in written]
    assert counts == [(11, True), (4, True)]
