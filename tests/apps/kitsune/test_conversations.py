"""Replies are charged to whoever began the conversation, and to nobody who did not."""

import pytest

from apps.kitsune.senders import REPLIES_PER_PACKET
from tests.naive.kitsune.conversations import Conversations

CLIENT, SERVER = (4, 0, 0x0A000001), (4, 0, 0x0A000002)
SYN, SYN_ACK, RST, ACK = 0x02, 0x12, 0x04, 0x10


def say(talk, time, source, destination, ports, flags=0, *, tcp=True):
    number = {CLIENT: 1, SERVER: 2}[source]
    key = (tcp, source, ports[0], ports[1])
    reverse = (tcp, destination, ports[1], ports[0])
    return talk.responsible(number, time, key, reverse, flags)


@pytest.mark.parametrize("flags", [SYN_ACK, RST, RST | ACK])
def test_answers_of_a_flooded_server_are_charged_to_the_flooder(flags):
    talk = Conversations()
    for port in range(1000, 1050):
        assert say(talk, 0.0, CLIENT, SERVER, (port, 80), SYN) == 1
        assert say(talk, 0.1, SERVER, CLIENT, (80, port), flags) == 1
    assert say(talk, 60.0, SERVER, CLIENT, (80, 1049), flags) == 1
    assert say(talk, 70.0, SERVER, CLIENT, (80, 1049), flags) == 2


def test_syn_acks_out_of_the_blue_are_the_senders_own():
    assert say(Conversations(), 0.0, SERVER, CLIENT, (80, 1000), SYN_ACK) == 2


def test_data_of_the_answering_side_is_its_own():
    talk = Conversations()
    say(talk, 0.0, CLIENT, SERVER, (1000, 80), SYN)
    assert say(talk, 0.2, SERVER, CLIENT, (80, 1000), ACK) == 2
    assert say(talk, 0.3, CLIENT, SERVER, (1000, 80), ACK) == 1


def test_udp_answers_are_charged_for_five_seconds():
    talk = Conversations()
    say(talk, 0.0, CLIENT, SERVER, (1000, 53), tcp=False)
    assert say(talk, 4.9, SERVER, CLIENT, (53, 1000), tcp=False) == 1
    talk = Conversations()
    say(talk, 0.0, CLIENT, SERVER, (1000, 53), tcp=False)
    assert say(talk, 5.1, SERVER, CLIENT, (53, 1000), tcp=False) == 2


def test_answers_to_a_search_by_multicast_are_charged_to_the_searcher():
    talk = Conversations()
    say(talk, 0.0, CLIENT, (4, 0, 0xEFFFFFFA), (1000, 1900), tcp=False)
    assert say(talk, 0.5, SERVER, CLIENT, (1900, 1000), tcp=False) == 1


def test_icmp_errors_are_charged_to_who_sent_the_quoted_packet():
    talk = Conversations()
    say(talk, 0.0, CLIENT, SERVER, (1000, 7), tcp=False)
    assert talk.responsible_for_error(2, 0.1, (False, CLIENT, 1000, 7)) == 1
    assert talk.responsible_for_error(2, 0.1, (False, CLIENT, 1001, 7)) == 2


def test_a_flood_of_answers_is_not_charged_to_its_victim():
    talk = Conversations()
    say(talk, 0.0, CLIENT, SERVER, (1000, 123), tcp=False)
    responsible = [say(talk, 0.1, SERVER, CLIENT, (123, 1000), tcp=False) for _ in range(100)]
    assert responsible == [1] * REPLIES_PER_PACKET + [2] * (100 - REPLIES_PER_PACKET)


def test_memory_is_bounded():
    talk = Conversations()
    for number in range(200_000):
        say(talk, number / 1e5, CLIENT, SERVER, (number, 80), SYN)
    assert len(talk._young) + len(talk._old) <= 2 * 65_536
