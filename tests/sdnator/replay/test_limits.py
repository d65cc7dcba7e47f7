"""Which packets a rate limit of a replay looked at, and what one of a dry run would have dropped."""

import numpy as np
import pytest
from scapy.layers.inet import ICMP, IP, TCP, UDP
from scapy.layers.inet6 import ICMPv6EchoRequest, IPv6
from scapy.layers.l2 import Ether

from apps.messages import Decision, RateLimit, Target
from sdnator.capture.captures import CaptureWriter
from sdnator.replay.limits import limited_packets

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND
VICTIM = "10.0.0.1"


def meter(at=T0, action="meter", victim=VICTIM, dry_run=False, **limit):
    fields = {"kind": "udp_from", "port": 53, "rate": 2} | limit
    return Decision(
        id=f"limit {victim} {fields['kind']}",
        action=action,
        switch="*",
        target=Target(kind="ip", address=victim),
        reason="a flood",
        event_time=at,
        expires=T0 + 100 * SECOND,
        dry_run=dry_run,
        limit=RateLimit(**fields),
    )


@pytest.fixture
def capture(tmp_path):
    """Ten answers within 0.1 s; then a packet a second of other kinds, and of another host."""
    answers = [Ether() / IP(src="192.0.2.1", dst=VICTIM) / UDP(sport=53, dport=4000) for _ in range(9)]
    answers.append(Ether() / IP(src="192.0.2.53", dst=VICTIM) / UDP(sport=53, dport=4000))
    others = [
        Ether() / IP(src="192.0.2.1", dst="10.0.0.2") / UDP(sport=53, dport=4000),
        Ether() / IP(src="192.0.2.1", dst=VICTIM) / UDP(sport=123, dport=4000),
        Ether() / IP(src="192.0.2.1", dst=VICTIM) / TCP(sport=53, dport=80, flags="A"),
        Ether() / IP(src="192.0.2.1", dst=VICTIM) / TCP(sport=53, dport=80, flags="S"),
        Ether() / IP(src="192.0.2.1", dst=VICTIM) / ICMP(),
        Ether() / IPv6(src="2001:db8::9", dst="2001:db8::1") / ICMPv6EchoRequest(),
    ]
    path = tmp_path / "flood.pcap"
    with CaptureWriter(path) as writer:
        for number, frame in enumerate(answers):
            writer.write(T0 + number * SECOND // 100, bytes(frame))
        for number, frame in enumerate(others, start=1):
            writer.write(T0 + number * SECOND, bytes(frame))
    return path


@pytest.mark.parametrize(
    ("limit", "packets"),
    [
        ({}, list(range(10))),
        ({"kind": "udp_to", "port": 4000}, [*range(10), 11]),
        ({"kind": "udp", "port": None}, [*range(10), 11]),
        ({"kind": "tcp", "port": 80}, [12]),
        ({"kind": "syn", "port": None}, [13]),
        ({"kind": "syn", "port": None, "open_ports": (22,)}, [13]),
        ({"kind": "syn", "port": None, "open_ports": (80,)}, []),
        ({"kind": "icmp", "port": None}, [14]),
        ({"kind": "icmp", "port": None, "victim": "2001:db8::1"}, [15]),
        ({"victim": "10.0.0.0/24"}, list(range(11))),
        ({"at": T0 + SECOND // 20}, [5, 6, 7, 8, 9]),
    ],
)
def test_packets_that_a_limit_looks_at(capture, limit, packets):
    found = limited_packets(capture, 16, [meter(**limit)])
    assert found.seen.nonzero()[0].tolist() == packets
    assert not found.would.any()


def test_it_ends_when_it_is_lifted(capture):
    lifted = meter(at=T0 + SECOND // 50, action="unmeter")
    assert limited_packets(capture, 16, [meter(), lifted]).seen.nonzero()[0].tolist() == [0, 1]


def test_a_dry_run_says_what_it_would_have_dropped(capture):
    """Two at once pass; beyond them the source that is spared has two of its own."""
    found = limited_packets(capture, 16, [meter(dry_run=True, spared=("192.0.2.53",), spared_rate=2)])
    assert found.would.nonzero()[0].tolist() == list(range(2, 9))
    assert not found.seen.any()
    (row,) = found.rows(np.arange(16) * SECOND + T0, np.zeros(16, bool))
    assert (row["effect"], row["packets_would_be_dropped"], row["packets_dropped"]) == ("would limit", 7, 0)


def test_a_row_says_what_passed_and_what_was_dropped(capture):
    dropped = np.zeros(16, bool)
    dropped[4:10] = dropped[15] = True
    (row,) = limited_packets(capture, 16, [meter()]).rows(np.arange(16) * SECOND + T0, dropped)
    assert (row["effect"], row["packets_dropped"], row["packets_passed"]) == ("limited", 6, 4)
    assert row["packets"] == "UDP from port 53"
