"""What evidence says reads as English: one of a thing in the singular, and ARP by what it lacks."""

import pytest

from apps.kitsune.behaviour.contacts import ARP, UDP, UNANSWERED
from apps.kitsune.behaviour.findings import Finding
from apps.kitsune.behaviour.rows import address_of
from apps.kitsune.evidence import evidence_of, facts_of
from apps.kitsune.roles import Roles
from apps.kitsune.victims import UsualTraffic

HOST, VICTIM = address_of(4, 0, 0xC0A80205), address_of(4, 0, 0xC0A80209)


def words(statistic, count, service=-1, usual=0.0):
    return told(statistic, count, service, usual).text


def told(statistic, count, service=-1, usual=0.0, came=None):
    sender = ("s1", 1, 5, HOST)
    finding = Finding(
        statistic=statistic, sender=sender, victim=VICTIM, service=service, nats=3.0, total=3.0,
        count=count, window_s=10.0, usual=usual, begun=98.5, time=100.0, arrival=7,
    )  # fmt: skip
    facts = facts_of(sender, Roles(), proven=False, forged=False, rate=1.0, training_rate=1.0)
    return evidence_of(finding, facts, came)


@pytest.mark.parametrize(
    ("count", "said"), [(1, "sent 1 packet a second to 192.168.2.9"), (2, "sent 2 packets a second to")]
)
def test_one_packet_is_not_packets(count, said):
    assert said in words("one_way", count)


def test_an_arp_sweep_is_told_by_the_replies_that_are_missing():
    assert "192.168.2.5 got no ARP reply from 4 new hosts within 10 s" in words("targets", 4, ARP)


def test_a_sweep_by_pings_is_told_by_what_does_not_answer():
    assert "192.168.2.5 got no echo reply from 4 new hosts within 10 s" in words("targets", 4, UNANSWERED)


@pytest.mark.parametrize(("usual", "said"), [(0.0, "no host"), (1.0, "1 host"), (2.0, "2 hosts")])
def test_hosts_that_did_so_are_counted_in_words(usual, said):
    assert words("callbacks", 1, 0, usual=usual).endswith(f"; {said} did so in training")


@pytest.mark.parametrize(("usual", "said"), [(0.0, "none in training"), (7.0, "at most 7 in training")])
def test_what_training_saw_is_said_without_a_zero(usual, said):
    assert words("one_way", 33, usual=usual).endswith(f"; {said}")


def test_a_flood_says_what_came_to_its_victim_in_training():
    """Where its sender cannot be blocked, a rate limit towards the victim rests on it."""
    came = UsualTraffic(9.0, 40.0, (VICTIM,), 0.5)
    found = told("one_way", 500, UDP | 5060, came=came)
    assert (found.usual_rate, found.usual_sources, found.usual_share) == (40.0, ("192.168.2.9",), 0.5)
    assert (found.rate, found.training_rate) == (1.0, 1.0), "of the sender"
