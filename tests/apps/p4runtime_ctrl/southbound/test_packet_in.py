"""Packet-ins become columns in order; what is no copied frame is left out."""

import numpy as np
import pytest

from apps.p4runtime_ctrl.errors import P4InfoError
from apps.p4runtime_ctrl.southbound.loss_tracker import LossTracker
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.packet_in import PacketReader
from sdnator.testing.product_program import EVERY_PACKET, packet_in, program
from tests.requirements import shared_data

BASE_US = 1_540_446_400_000_000


def reader():
    return PacketReader(program(), BASE_US, LossTracker())


def test_columns_hold_the_header_in_the_order_of_arrival():
    found = reader().read(
        [
            packet_in(1, arrival=4, port=3, timestamp=77, length=1500, frame=b"ab"),
            packet_in(2, arrival=9, port=1, timestamp=(1 << 40) + 5, frame=b"cde"),
        ]
    )
    assert found.frames == [b"ab", b"cde"]
    assert found.sequence.tolist() == [1, 2]
    assert found.arrival.tolist() == [4, 9]
    assert found.port.tolist() == [3, 1]
    assert found.length.tolist() == [1500, 3]
    assert found.time_us.tolist() == [BASE_US + 77, BASE_US + (1 << 40) + 5]
    assert found.time_us.dtype == np.int64


def test_metadata_in_any_order():
    message = packet_in(7, port=2)
    shuffled = packet_in(7, port=2)
    del shuffled.metadata[:]
    shuffled.metadata.extend(reversed(message.metadata))
    found = reader().read([shuffled])
    assert (found.sequence[0], found.port[0]) == (7, 2)


def test_answers_to_packet_outs_are_no_frames():
    progress = LossTracker()
    found = PacketReader(program(), 0, progress).read(
        [packet_in(1), packet_in(4_000_000, reason=1), packet_in(2)]
    )
    assert found.sequence.tolist() == [1, 2]
    assert (progress.received, progress.lost) == (2, 0)


def test_reading_nothing():
    assert len(reader().read([])) == 0


def test_packets_of_one_query():
    found = reader().read([packet_in(1), packet_in(2, queries=1), packet_in(3, queries=EVERY_PACKET | 1)])
    assert found.matching(255).sequence.tolist() == [1, 3]
    assert found.matching(0).sequence.tolist() == [2, 3]
    assert len(found.matching(7)) == 0
    every = reader().read([packet_in(1), packet_in(2)])
    assert every.matching(255) is every


def test_a_program_without_the_header_is_refused():
    small = ProgramInfo.from_text(shared_data("p4/small.p4info.txtpb").read_text())
    with pytest.raises(P4InfoError, match="lacks timestamp, length, sequence, arrival, query_map"):
        PacketReader(small, 0, LossTracker())
