"""The RST is what a server takes for its client's: right numbers, right checksums, right tag."""

import ipaddress
import struct

import pytest

from apps.firewall.syn.tcp_reset import HalfOpen, reset_frame
from apps.packets import read_frames


def half(client: str, server: str, vlan: int = -1) -> HalfOpen:
    near, far = ipaddress.ip_address(client), ipaddress.ip_address(server)
    return HalfOpen(
        near.version, int(near), 40_001, int(far), 80, 0xFFFF_FFFE, 0x020000000002, 0x020000000001, vlan, 3
    )


def ones_sum(data: bytes) -> int:
    """The plain way: words added with end-around carry."""
    total = 0
    for (word,) in struct.iter_unpack(">H", data):
        total += word
        total = (total & 0xFFFF) + (total >> 16)
    return total


@pytest.mark.parametrize("vlan", [-1, 7])
@pytest.mark.parametrize(("client", "server"), [("10.2.0.9", "10.0.0.1"), ("2001:db8::9", "2001:db8::1")])
def test_frame_is_read_as_what_it_is(client, server, vlan):
    """From client to server, to the server's MAC, with the number that the server expects."""
    frame = reset_frame(half(client, server, vlan))
    row = read_frames([frame], lengths=[len(frame)], times_us=[0], ports=[0], sequence=[0], arrival=[0])
    version = ipaddress.ip_address(client).version
    seen = {name: row[name].tolist()[0] for name in row.columns}
    assert (seen["ip_version"], seen["vlan"]) == (version, vlan)
    assert (seen["eth_src"], seen["eth_dst"]) == (0x020000000002, 0x020000000001)
    assert seen["ip_src_hi"] << 64 | seen["ip_src_lo"] == int(ipaddress.ip_address(client))
    assert seen["ip_dst_hi"] << 64 | seen["ip_dst_lo"] == int(ipaddress.ip_address(server))
    assert (seen["tcp_sport"], seen["tcp_dport"]) == (40_001, 80)
    assert (seen["tcp_flags"], seen["tcp_seq"]) == (4, 0xFFFF_FFFE)


@pytest.mark.parametrize(
    ("client", "server", "at"), [("10.2.0.9", "10.0.0.1", 26), ("2001:db8::9", "2001:db8::1", 22)]
)
def test_checksums(client, server, at):
    """Over header and pseudo header everything adds up to all ones."""
    frame = reset_frame(half(client, server))
    size = ipaddress.ip_address(client).max_prefixlen // 8
    segment = frame[at + 2 * size :]
    assert len(segment) == 20
    pseudo = frame[at : at + 2 * size] + struct.pack(">HH", 6, len(segment))
    assert ones_sum(pseudo + segment) == 0xFFFF
    if size == 4:
        assert ones_sum(frame[14:34]) == 0xFFFF
