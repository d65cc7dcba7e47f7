"""The house is as busy as the house of the public capture, whatever the seed."""

import collections

import pytest

from sdnator.datasets import benign, hosts
from sdnator.datasets.traffic import SECOND

HOUR = 3_600 * SECOND


def test_same_seed_same_traffic():
    assert benign.traffic(5, 0, 60 * SECOND, 45 * SECOND) == benign.traffic(5, 0, 60 * SECOND, 45 * SECOND)
    assert benign.traffic(5, 0, 60 * SECOND, 45 * SECOND) != benign.traffic(6, 0, 60 * SECOND, 45 * SECOND)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_everybody_speaks(seed):
    """All devices but the intruder are heard in an hour, none of them names an attacker, in order of time."""
    sent = benign.traffic(seed, 0, HOUR, HOUR)
    assert {packet.src.mac_text for packet in sent} == {
        host.mac_text for host in (*hosts.LAN_HOSTS, hosts.SWITCH) if host is not hosts.INTRUDER
    }
    assert not any(packet.attacker for packet in sent)
    times = [packet.time for packet in sent]
    assert times == sorted(times)
    assert times[0] >= 0
    assert times[-1] < HOUR
    talkers = collections.Counter(packet.src.mac_text for packet in sent).most_common(2)
    assert talkers[0][0] == hosts.CAMERA_WIRED.mac_text


def test_ssdp_bursts_and_the_new_habit():
    """The gateway announces 22 services in a burst; the PC's searches begin at `news`, not before."""
    sent = benign.traffic(1, 0, HOUR, HOUR // 2)
    announced = [packet for packet in sent if packet.src is hosts.GATEWAY and packet.dst == hosts.SSDP_GROUP]
    assert len([packet for packet in announced if packet.sport == 1900]) % 11 == 0
    searches = [packet.time for packet in sent if packet.src is hosts.PC and packet.dport == 1900]
    assert searches
    assert min(searches) >= HOUR // 2
