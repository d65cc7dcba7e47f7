"""What guards would have challenged: SYNs to their service, while they stood, of strangers."""

import pytest
from scapy.layers.inet import IP, TCP
from scapy.layers.inet6 import IPv6
from scapy.layers.l2 import Ether

from apps.messages import Decision, Target
from sdnator.capture.captures import CaptureWriter
from sdnator.replay.guards import would_challenge

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND


def protect(address="10.0.0.1", *, at=T0 + SECOND, action="protect", expires=T0 + 100 * SECOND):
    target = Target(kind="ip", address=address, port=80)
    return Decision(
        id=f"guard {address}",
        action=action,
        switch="*",
        target=target,
        reason="a flood",
        event_time=at,
        expires=expires,
        dry_run=True,
    )


@pytest.fixture
def capture(tmp_path):
    """One packet a second: SYNs but for one, to three services, from two sources."""
    four = [("10.0.0.1", 80), ("10.0.0.1", 80), ("10.0.0.1", 81), ("10.0.0.2", 80), ("10.0.0.1", 80)]
    frames = [Ether() / IP(src="10.9.0.1", dst=dst) / TCP(dport=port, flags="S") for dst, port in four]
    frames.append(Ether() / IP(src="10.9.0.2", dst="10.0.0.1") / TCP(dport=80, flags="S"))
    frames.append(Ether() / IP(src="10.9.0.2", dst="10.0.0.1") / TCP(dport=80, flags="A"))
    frames.append(Ether() / IPv6(src="2001:db8::9", dst="2001:db8::1") / TCP(dport=80, flags="S"))
    path = tmp_path / "syns.pcap"
    with CaptureWriter(path) as writer:
        for second, frame in enumerate(frames):
            writer.write(T0 + second * SECOND, bytes(frame))
    return path


@pytest.mark.parametrize(
    ("decisions", "handshakes", "packets"),
    [
        ([], [], []),
        ([protect()], [], [1, 4, 5]),
        ([protect()], [(T0 + 3 * SECOND, "10.9.0.1")], [1, 5]),
        ([protect(), protect(at=T0 + 4 * SECOND, action="unprotect")], [], [1]),
        ([protect(expires=T0 + 5 * SECOND)], [], [1, 4]),
        ([protect(), protect("2001:db8::1")], [], [1, 4, 5, 7]),
    ],
)
def test_syns_that_would_be_challenged(capture, decisions, handshakes, packets):
    found = would_challenge(capture, 8, decisions, handshakes)
    assert found.packets.nonzero()[0].tolist() == packets
    assert sum(count for _, count in found.by_guard) == len(packets)
