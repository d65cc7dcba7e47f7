"""Services of generated traffic are those with which somebody has completed a handshake."""

from benchmarks.decision_services import services_of
from tests.apps.kitsune.behaviour.test_behaviour import SYN, handshake, packet
from tests.benchmarks.test_planted_evidence import ATTACKER, HOST, SERVER, traffic


def test_a_scan_makes_no_port_a_service():
    """Open ones answer the scanner, too, which goes no further; nor does an ACK alone."""
    scanned = handshake(4, ATTACKER, SERVER, 40_000, 22)[:2]
    alone = [handshake(6, ATTACKER, SERVER, 40_001, 23)[2], packet(7, ATTACKER, SERVER, 40_002, 25, SYN)]
    done = handshake(1, HOST, SERVER, 30_000, 80) + handshake(2, HOST, SERVER, 30_001, 443)
    assert services_of(traffic([*done, *scanned, *alone])) == {"10.0.0.1": {80, 443}}


def test_without_packets_there_are_none():
    assert services_of(traffic(handshake(1, HOST, SERVER, 30_000, 80)[:1])) == {}
