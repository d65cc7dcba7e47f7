"""Top talkers are those who sent most bytes in a window of capture time, whatever else comes."""

import itertools
from collections import Counter

import numpy as np
import pytest

from apps.kitsune.top_talkers import MOST_SENDERS, WINDOW_US, TalkerTable
from apps.messages import MessageError
from apps.talkers import MOST_TALKERS, TopTalkers
from sdnator.testing.packet_rows import blank, part


def traffic(count, seconds, seed=1):
    """Packets of 60 hosts behind two ports: IPv4, IPv6, and some without IP."""
    random = np.random.default_rng(seed)
    host = random.integers(0, 60, count)
    version = np.array([4, 6, 0], dtype="u1")[host % 3]
    return blank(
        count,
        time_us=np.sort(random.integers(0, seconds * 1_000_000, count)),
        port=1 + host % 2,
        length=random.integers(60, 1_500, count),
        eth_src=0x02_00_00_00_00_00 + host,
        ip_version=version,
        ip_src_hi=np.where(version == 6, 0x2001 << 48, 0).astype("u8"),
        ip_src_lo=np.where(version > 0, 0x0A000000 + host, 0).astype("u8"),
    )


def told(table, batch, size):
    found = [table.add(part(batch, at, at + size), "s1") for at in range(0, len(batch["port"]), size)]
    return [one for one in found if one is not None]


def test_sums_are_those_of_counting_packet_by_packet():
    """However packets are cut into batches, bytes by sender are those that one loop over all packets counts."""
    batch = traffic(4_000, 3)
    (found, *_) = told(TalkerTable(), batch, 37)
    inside = batch["time_us"] * 1_000 <= found.event_time
    octets, packets = Counter(), Counter()
    for row in np.flatnonzero(inside):
        who = (int(batch["port"][row]), int(batch["eth_src"][row]))
        octets[who] += int(batch["length"][row])
        packets[who] += 1
    assert (found.packets, found.bytes) == (packets.total(), octets.total())
    wanted = sorted(octets, key=lambda who: -octets[who])[:MOST_TALKERS]
    told_of = [(one.sender.port, int(one.sender.mac.replace(":", ""), 16)) for one in found.talkers]
    assert told_of == wanted
    assert [(one.packets, one.bytes) for one in found.talkers] == [
        (packets[who], octets[who]) for who in wanted
    ]


def test_senders_go_by_their_addresses():
    """IPv4, IPv6, and the MAC address where there is no IP address."""
    batch = blank(
        3,
        time_us=[0, 1, WINDOW_US],
        length=[300, 200, 100],
        eth_src=[1, 2, 3],
        ip_version=[4, 6, 0],
        ip_src_hi=[0, 0x2001_0DB8 << 32, 0],
        ip_src_lo=[0x0A000001, 5, 0],
    )
    found = TalkerTable().add(batch, "s1")
    assert [one.sender.ip or one.sender.mac for one in found.talkers] == [
        "10.0.0.1",
        "2001:db8::5",
        "00:00:00:00:00:03",
    ]
    assert TopTalkers.from_value(found.to_value()) == found


def test_a_flood_from_forged_addresses_does_not_hide_a_talker():
    """Sums are bounded; the senders with the fewest bytes are forgotten, and the totals count them."""
    count = 4 * MOST_SENDERS
    forged = np.arange(count) % 4 != 0
    batch = blank(
        count,
        time_us=np.linspace(0, WINDOW_US, count).astype("i8"),
        length=np.where(forged, 60, 1_500),
        eth_src=np.full(count, 7),
        ip_version=np.full(count, 4),
        ip_src_lo=np.where(forged, 0x0B000000 + np.arange(count), 0x0A000001).astype("u8"),
    )
    (found,) = told(TalkerTable(), batch, 1_000)
    first = found.talkers[0]
    assert (first.sender.ip, first.packets) == ("10.0.0.1", count // 4)
    assert found.packets == count


def test_switches_are_counted_apart_and_windows_follow_one_another():
    table = TalkerTable()
    batch = traffic(1_000, 9)
    windows = told(table, batch, 50)
    assert table.add(part(batch, 0, 50), "s2") is None
    assert len(windows) > 2
    assert all(one.since >= before.event_time for before, one in itertools.pairwise(windows))


@pytest.mark.parametrize(
    "wrong",
    [
        {"since": 5, "event_time": 4},
        {"talkers": [{"sender": {"switch": "s1", "port": 1, "mac": "no"}, "packets": 1, "bytes": 1}]},
        {"talkers": [{}] * (MOST_TALKERS + 1)},
    ],
)
def test_impossible_lists_are_refused(wrong):
    value = {"switch": "s1", "since": 0, "event_time": 1, "packets": 0, "bytes": 0, "talkers": []}
    TopTalkers.from_value(value)
    with pytest.raises(MessageError):
        TopTalkers.from_value(value | wrong)
