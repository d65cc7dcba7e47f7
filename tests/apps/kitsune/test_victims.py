"""What came to a host in training, by kind and source; and what comes now."""

import numpy as np
import pytest
from scapy.layers.inet import ICMP, IP, TCP
from scapy.layers.inet import UDP as UDP_LAYER
from scapy.layers.l2 import Ether

from apps.kitsune.behaviour.contacts import ANY_UDP, ECHO, FROM_UDP, STRAY_TCP, UDP
from apps.kitsune.victims import VictimRates
from apps.packets import read_frames

HOST = "10.0.0.1"
ADDRESS = 10 << 24 | 1


def number(address):
    return int.from_bytes(bytes(map(int, address.split("."))), "big")


def batch(*packets):
    """Pairs of second and packet."""
    frames = [bytes(Ether() / packet) for _, packet in packets]
    count = len(frames)
    return read_frames(
        frames,
        lengths=np.array([len(each) for each in frames], np.uint32),
        times_us=np.array([int(at * 1_000_000) for at, _ in packets], np.int64),
        ports=np.ones(count, np.uint16),
        sequence=np.arange(count, dtype=np.uint64),
        arrival=np.arange(count, dtype=np.uint64),
    )


def answer(source="192.0.2.53", host=HOST, port=53):
    return IP(src=source, dst=host) / UDP_LAYER(sport=port, dport=4000)


@pytest.mark.parametrize(
    ("packet", "kinds"),
    [
        (answer(), {FROM_UDP | 53, ANY_UDP}),
        (answer(port=5000), {UDP | 4000, ANY_UDP}),
        (IP(src="192.0.2.1", dst=HOST) / TCP(dport=443, flags="A"), {STRAY_TCP | 443}),
        (IP(src="192.0.2.1", dst=HOST) / TCP(dport=443, flags="S"), set()),
        (IP(src="192.0.2.1", dst=HOST) / ICMP(type=8), {ECHO}),
        (IP(src="192.0.2.1", dst=HOST) / ICMP(type=0), set()),
    ],
)
def test_kinds(packet, kinds):
    rates = VictimRates()
    rates.add(batch((1, packet)), 1)
    every = (FROM_UDP | 53, UDP | 4000, ANY_UDP, STRAY_TCP | 443, ECHO)
    assert {each for each in every if rates.usual(ADDRESS, each).training_rate} == kinds


def test_the_busiest_second_of_training_and_its_sources():
    rates = VictimRates()
    rates.add(batch((1, answer()), (2.0, answer()), (2.5, answer()), (2.9, answer("192.0.2.54"))), 4)
    rates.add(batch(*[(5 + n / 1000, answer("198.51.100.1")) for n in range(50)]), 0)
    usual = rates.usual(ADDRESS, FROM_UDP | 53)
    assert (usual.rate, usual.training_rate, usual.share) == (50.0, 3.0, 1.0)
    assert usual.sources == (number("192.0.2.53"), number("192.0.2.54"))


def test_training_may_end_within_a_batch():
    rates = VictimRates()
    rates.add(batch((1, answer()), (1.1, answer("198.51.100.1")), (1.2, answer("198.51.100.1"))), 1)
    usual = rates.usual(ADDRESS, FROM_UDP | 53)
    assert (usual.training_rate, usual.sources) == (1.0, (number("192.0.2.53"),))


def test_of_many_sources_the_busiest_are_named_and_their_share_is_told():
    rates = VictimRates()
    crowd = [(1 + n / 1000, answer(f"198.51.{n}.1")) for n in range(100)]
    rates.add(batch(*crowd, *[(1.2 + n / 1000, answer()) for n in range(100)]), 200)
    usual = rates.usual(ADDRESS, FROM_UDP | 53)
    assert usual.sources[0] == number("192.0.2.53")
    assert (len(usual.sources), usual.share) == (64, (100 + 63) / 200)


def test_a_host_that_training_did_not_see_has_nothing():
    usual = VictimRates().usual(ADDRESS, ECHO)
    assert usual == (0.0, 0.0, (), 0.0)


def test_a_model_file_keeps_it():
    rates = VictimRates()
    rates.add(batch((1, answer()), (1.5, answer("192.0.2.54"))), 2)
    again = VictimRates.from_state(rates.to_state())
    assert again.usual(ADDRESS, FROM_UDP | 53)[1:] == rates.usual(ADDRESS, FROM_UDP | 53)[1:]


@pytest.mark.parametrize("wrong", [[[1]], [["x", 1, 1, 1, []]], [[1, 1, 1, 1, [[1]]]]])
def test_a_damaged_state_is_refused(wrong):
    with pytest.raises((TypeError, ValueError)):
        VictimRates.from_state(wrong)
