"""Labels of flows reach exactly the packets that the flow's originator sent in its time."""

from ipaddress import ip_address
from pathlib import Path

import pytest

from sdnator.capture.captures import CaptureWriter
from sdnator.datasets import flow_labels, frames
from sdnator.datasets.flow_labels import labels_of_flows
from sdnator.datasets.flow_tables import FlowTableError, LabelledFlow

T0 = 1_525_879_831 * 10**9
SECOND = 10**9
BOT, VICTIM, OTHER = "10.0.0.66", "10.0.0.2", "10.0.0.3"


def _packed(address: str) -> bytes:
    return ip_address(address).packed


def _syn(source: str, sport: int, destination: str, dport: int) -> bytes:
    segment = sport.to_bytes(2, "big") + dport.to_bytes(2, "big") + bytes(8) + b"\x50\x02" + bytes(6)
    ends = (_packed(source), _packed(destination))
    packet = frames.ipv4(*ends, 6, segment) if "." in source else frames.ipv6(*ends, 6, segment)
    return frames.ethernet(b"\2" * 6, b"\4" * 6, 0x0800 if "." in source else 0x86DD, packet)


def _flow(begin: int, end: int, attack: bool = True, source: str = BOT, dport: int = 23) -> LabelledFlow:
    target = VICTIM if "." in source else "fd00::2"
    ends = (int(ip_address(source)), int(ip_address(target)))
    return LabelledFlow(T0 + begin * SECOND, T0 + end * SECOND, *ends, 4000, dport, 6, attack)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Ten seconds: each second a SYN of the bot, an answer, and somebody else's SYN."""
    path = tmp_path / "c.pcap"
    with CaptureWriter(path) as writer:
        for second in range(10):
            writer.write(T0 + second * SECOND, _syn(BOT, 4000, VICTIM, 23))
            writer.write(T0 + second * SECOND + 1000, _syn(VICTIM, 23, BOT, 4000))
            writer.write(T0 + second * SECOND + 2000, _syn(OTHER, 4000, VICTIM, 23))
        writer.write(T0 + 9 * SECOND, _syn("fd00::66", 4000, "fd00::2", 23))
    return path


def test_only_the_originators_packets_in_the_flows_time(capture):
    """A second around the flow counts, answers and others' packets do not, and senders are named."""
    found = labels_of_flows(capture, [_flow(3, 5), _flow(0, 9, attack=False), _flow(50, 60)])
    seconds = [index // 3 for index in found.labels.attack.nonzero()[0].tolist()]
    assert seconds == [2, 3, 4, 5, 6]
    assert all(found.labels.attacker(3 * second) == BOT for second in seconds)
    assert found.labels.attackers == {BOT}
    assert (found.flows, found.flows_found) == (2, 1)


def test_overlapping_flows_in_many_chunks(capture, monkeypatch):
    """Flows are taken in chunks: memory does not grow with them, and overlaps count once."""
    monkeypatch.setattr(flow_labels, "_CHUNK", 2)
    flows = [_flow(second, second + 2) for second in range(-3, 4)]
    found = labels_of_flows(capture, iter(flows))
    assert found.labels.attack.nonzero()[0].tolist() == [0, 3, 6, 9, 12, 15, 18]


def test_ipv6_and_ports_decide(capture):
    """The same addresses with another port are another flow; IPv6 works likewise."""
    found = labels_of_flows(capture, [_flow(0, 9, dport=24), _flow(8, 9, source="fd00::66")])
    assert found.labels.attack.nonzero()[0].tolist() == [30]
    assert found.labels.attackers == {"fd00::66"}


def test_a_table_of_another_capture_is_refused(capture):
    """Attacks of which nothing is in the capture: the wrong table, or the wrong clock."""
    with pytest.raises(FlowTableError, match=r"none of 2 flows .* ahead of UTC"):
        labels_of_flows(capture, [_flow(100, 200), _flow(-200, -100)])


def test_no_attacks_at_all(capture):
    """Benign flows make benign labels."""
    found = labels_of_flows(capture, [_flow(0, 9, attack=False)])
    assert not found.labels.attack.any()
    assert found.labels.names == ("",)
