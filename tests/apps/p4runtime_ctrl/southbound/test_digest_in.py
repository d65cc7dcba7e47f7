"""Digests of the parser become the same records as the frames would, with the reports of counting beside."""

import numpy as np
import pytest

from apps.p4runtime_ctrl.errors import P4InfoError
from apps.p4runtime_ctrl.southbound.digest_in import DigestReader
from apps.p4runtime_ctrl.southbound.loss_tracker import LossTracker
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.sequence_merge import PacketRows
from apps.p4runtime_ctrl.southbound.values import canonical
from apps.packets import PACKET_COLUMNS
from p4rt import p4runtime
from sdnator.testing.product_program import program
from tests.requirements import shared_data

DIGEST = "frame_digest_t"
SYN = {
    "queries": 1 << 255, "timestamp": 7, "arrival": 3, "sequence": 4, "ingress_port": 1, "length": 60,
    "ethertype": 0x0800, "eth_src": 0x020000000001, "eth_dst": 0x020000000002, "is_ipv4": 1,
    "src": 0x0A000001, "dst": 0x0A000002, "protocol": 6, "l4_valid": 1, "sport": 1000, "dport": 23,
    "tcp_flags": 2, "tcp_sequence": 99,
}  # fmt: skip
ARP = {
    "queries": 1 << 255, "timestamp": 8, "arrival": 4, "sequence": 5, "ethertype": 0x0806, "is_ipv4": 1,
    "vid": 7, "src": 0x0A000001, "dst": 0x0A000002, "arp_operation": 2, "arp_sender_mac": 1, "arp_target_mac": 2,
}  # fmt: skip
QUOTED = {
    "crossed": 1 << 3, "timestamp": 9, "arrival": 5, "ethertype": 0x86DD, "src": 0x20010DB8 << 96, "protocol": 58,
    "l4_valid": 1, "icmp_type": 1, "icmp_code": 4, "quoted": 1, "quoted_protocol": 17, "sport": 5, "dport": 53,
}  # fmt: skip


def digest_list(*frames):
    found = p4runtime.DigestList(digest_id=program().digest_id(DIGEST))
    for frame in frames:
        members = found.data.add().struct.members
        for name, _ in program().digest(DIGEST):
            members.add(bitstring=canonical(frame.get(name, 0)))
    return found


def test_columns_and_reports():
    progress = LossTracker()
    reports = DigestReader(program(), 1000, progress).read([digest_list(SYN, ARP), digest_list(QUOTED)])
    records = PacketRows(reports.columns, reports.queries, reports.covered).matching(255)
    assert list(records.columns) == list(PACKET_COLUMNS)
    assert {name: str(np.dtype(kind)) for name, kind in PACKET_COLUMNS.items()} == {
        name: str(records[name].dtype) for name in records.columns
    }
    rows = {name: records[name].tolist() for name in records.columns}
    assert rows["time_us"] == [1007, 1008]
    assert rows["tcp_dport"] == [23, -1]
    assert (rows["tcp_flags"], rows["tcp_seq"]) == ([2, 0], [99, 0])
    assert (rows["arp_op"], rows["arp_src_ip"], rows["ip_version"]) == ([-1, 2], [0, 0x0A000001], [4, 0])
    assert (rows["vlan"], rows["eth_type"], rows["ip_proto"]) == ([-1, 7], [0x0800, 0x0806], [6, -1])
    counted = reports.counted(3)
    assert (counted["crossed"].tolist(), counted["overflow"].tolist()) == ([1], [0])
    assert (counted["udp_dport"][0], counted["icmp6_type"][0], counted["quoted"][0]) == (53, 1, 1)
    assert (counted["ip_src_hi"][0], counted["tcp_dport"][0]) == (0x20010DB8 << 32, -1)
    assert (progress.reported, progress.lost) == (3, 0)


@pytest.mark.parametrize(
    ("frame", "covered"),
    [
        (SYN, True),
        (ARP, True),
        (QUOTED, True),
        ({**SYN, "l4_valid": 0}, False),
        ({**SYN, "l4_valid": 0, "fragment": 2}, True),
        ({**SYN, "ethertype": 0x0042}, False),
        ({**SYN, "ethertype": 0x9100}, False),
        ({**SYN, "ethertype": 0x88CC, "l4_valid": 0}, True),
        ({**SYN, "protocol": 1, "sport": 0}, False),
        ({**QUOTED, "sport": 0}, False),
    ],
)
def test_what_the_parser_does_not_cover_is_known(frame, covered):
    assert DigestReader(program(), 0, LossTracker()).read([digest_list(frame)]).covered.tolist() == [covered]


def test_a_program_without_such_a_digest():
    small = ProgramInfo.from_text(shared_data("p4/small.p4info.txtpb").read_text())
    with pytest.raises(P4InfoError, match="no digest 'frame_digest_t'"):
        DigestReader(small, 0, LossTracker())
