"""What fills Kitsune's tables before a soak run: hosts that come once, in a chain."""

import numpy as np

from apps.firewall.settings import Settings
from apps.firewall.syn.syn_defence import SERVICES_LEARNT
from apps.kitsune.afterimage import MAX_LINKS, MAX_STREAMS, STREAMS_PER_LOG, AfterImage
from apps.kitsune.behaviour.behaviour import KEPT
from apps.kitsune.behaviour.contacts import MOST_CONTACTS
from apps.kitsune.senders import MOST_CONVERSATIONS, MOST_SENDERS
from apps.packets import read_frames
from apps.sonata_adapter.host.handshake import Handshakes
from benchmarks.soak_fill import FRAMES, HANDSHAKES, HUBS, LOGINS, PAIRS, UNANSWERED, fill_frames, fullness


def packets(pairs, unanswered=0, handshakes=0, logins=0, hubs=0):
    sides, frames = zip(*fill_frames(pairs, unanswered, handshakes, logins, hubs), strict=True)
    numbers = np.arange(len(frames))
    return read_frames(
        frames,
        lengths=[len(frame) for frame in frames],
        times_us=numbers * 250,
        ports=[side + 1 for side in sides],
        sequence=numbers,
        arrival=numbers + 1,
    )


def test_each_host_asks_the_next_one_through_the_switch_and_is_answered():
    columns = packets(130)
    asked = list(zip(columns["ip_src_lo"].tolist(), columns["ip_dst_lo"].tolist(), strict=True))
    first = min(min(asked))
    up = [(first + number, first + number + 1) for number in range(130)]
    assert sorted(asked) == sorted([*up, *((b, a) for a, b in up)])
    assert all(asked.index(pair) < asked.index(pair[::-1]) for pair in up)
    assert ((columns["ip_src_lo"] - first) % 2 + 1).tolist() == columns["port"].tolist()


def test_the_first_hosts_ask_twice_and_wait_in_vain_the_second_time():
    columns = packets(130, 70)
    silent = columns["udp_dport"] != columns["udp_dport"][0]
    asked = list(zip(columns["ip_src_lo"].tolist(), columns["ip_dst_lo"].tolist(), strict=True))
    again = [pair for pair, at in zip(asked, silent, strict=True) if at]
    assert again == [(asked[0][0] + number, asked[0][0] + number + 1) for number in range(70)]


def test_connections_make_known_sources_and_services_and_no_flood():
    columns = packets(0, 0, 200)
    assert ((columns["ip_src_lo"] - columns["ip_src_lo"].min()) % 2 + 1).tolist() == columns["port"].tolist()
    found = Handshakes().process(columns)
    assert len({each.source for each in found}) == len({each.service for each in found}) == 200
    assert {each.port for each in found} == {443}


def test_logins_are_asked_for_once_in_each_place():
    columns = packets(0, logins=100)
    assert ((columns["ip_src_lo"] - columns["ip_src_lo"].min()) % 2 + 1).tolist() == columns["port"].tolist()
    assert len(set(zip(columns["ip_src_lo"].tolist(), columns["ip_dst_lo"].tolist(), strict=True))) == 100
    assert set(columns["tcp_dport"].tolist()) == {22}
    assert set(columns["tcp_flags"].tolist()) == {2}
    assert KEPT < LOGINS < PAIRS - UNANSWERED  # nobody asks in vain twice


def test_as_many_frames_are_sent_as_there_are():
    assert len(list(fill_frames(130, 70, 100, 50, 3))) == 2 * 130 + 70 + 3 * 100 + 50 + 3 * 270
    assert FRAMES == 2 * PAIRS + UNANSWERED + 3 * HANDSHAKES + LOGINS + 270 * HUBS


def test_there_are_connections_enough_for_known_sources_and_services():
    assert max(Settings().known_limit, SERVICES_LEARNT) < HANDSHAKES
    assert HANDSHAKES < PAIRS


def test_headers_are_valid():
    for _, frame in fill_frames(3, 1, 2, 2, 1):
        words = np.frombuffer(frame[14:34], ">u2").astype(int).sum()
        assert words % 0xFFFF == 0
        assert int.from_bytes(frame[16:18], "big") == len(frame) - 14


def test_segments_have_their_checksum():
    for _, frame in fill_frames(0, 0, 2, 2, 0):
        words = np.frombuffer(frame[26:], ">u2").astype(int).sum() + 6 + len(frame) - 34
        assert words % 0xFFFF == 0


def test_tables_are_full_afterwards():
    """A fifth more pairs than entries, as in a soak run: there, more."""
    tables = AfterImage("bounded", max_streams=500, max_links=500)
    tables.update(packets(600))
    assert 4 * 490 < tables.counts["streams"] <= 4 * 500
    assert 2 * 490 < tables.counts["links"] <= 2 * 500
    assert tables.counts["forgotten_full"] > 0


def test_hubs_have_their_logs_filled():
    tables = AfterImage("bounded", max_streams=5000, max_links=5000)
    columns = packets(0, hubs=45)
    assert ((columns["ip_src_lo"] - columns["ip_src_lo"].min()) % 2 + 1).tolist() == columns["port"].tolist()
    tables.update(columns)
    assert 2 * 27 <= tables.counts["hub_logs"] <= 2 * 5000 // STREAMS_PER_LOG


def test_there_are_pairs_enough_for_every_table():
    """Contacts and conversations have two generations."""
    assert min(PAIRS / MAX_STREAMS, PAIRS / MAX_LINKS, PAIRS / MOST_SENDERS) > 1
    assert min(PAIRS / MOST_CONTACTS, PAIRS / MOST_CONVERSATIONS) > 2
    assert PAIRS < 1 << 22  # addresses of 100.64.0.0/10


def test_fullness_is_what_kitsune_says():
    told = {"apps": {"kitsune": {"health": {"app": {"streams": 7, "links": 3}}}}}
    assert fullness(told)["streams"] == {"entries": 7, "cap": 4 * MAX_STREAMS}
    assert fullness({})["links"] == {"entries": 0, "cap": 2 * MAX_LINKS}
