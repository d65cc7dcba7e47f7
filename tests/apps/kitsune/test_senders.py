"""A second is anomalous when at least three and at least half of a sender's packets are above the threshold; anomalous seconds add up."""

import numpy as np

from apps.kitsune.senders import Senders
from apps.messages import Target
from due import RecordBatch
from sdnator.testing.packet_rows import blank
from tests.apps.firewall.enforcement.test_eve import decision

HOST, OTHER = 0xC0A80205, 0xC0A80206
BASE_S = 1_600_000_000


def packets(rows):
    """Rows of (second, source address, score)."""
    seconds, sources, scores = (np.array(column) for column in zip(*rows, strict=True))
    return blank(
        len(rows),
        time_us=(BASE_S + seconds) * 1_000_000,
        port=np.full(len(rows), 3),
        eth_src=sources & 0xFF,
        eth_dst=np.full(len(rows), 9),
        ip_version=np.full(len(rows), 4),
        ip_src_lo=sources,
        ip_dst_lo=np.arange(len(rows)) % 3,
    ), scores.astype(float)


def feed(senders, rows, trained=0, threshold=1.0):
    batch, scores = packets(rows)
    return senders.add(
        batch, "s1", scores=scores, trained=trained, threshold=threshold, evidence=lambda row: row
    )


def trained_senders():
    senders = Senders()
    feed(senders, [(0, HOST, 0)] * 4 + [(1, HOST, 0)] * 2, trained=6)
    return senders


def test_a_second_becomes_anomalous_when_it_is_over():
    senders = trained_senders()
    assert feed(senders, [(5, HOST, 2)] * 3) == []
    (found,) = feed(senders, [(6, HOST, 0)])
    assert found.second == BASE_S + 5
    assert (found.tally.packets, found.tally.over, found.tally.peak, found.tally.first_over) == (3, 3, 2.0, 0)
    assert found.record.identity == ("s1", 3, HOST & 0xFF, (4, 0, HOST))
    assert (found.anomalous_seconds, found.record.training_rate) == (1, 4)


def test_two_packets_or_less_than_half_are_not_anomalous():
    senders = trained_senders()
    assert (
        feed(senders, [(5, HOST, 2)] * 2 + [(6, HOST, 2)] * 3 + [(6, HOST, 0.1)] * 4 + [(7, HOST, 0)]) == []
    )
    assert len(feed(senders, [(8, HOST, 2)] * 3 + [(8, HOST, 0.1)] * 3 + [(9, HOST, 0)])) == 1


def test_anomalous_seconds_of_the_last_ten_add_up():
    senders = trained_senders()
    rows = [(second, HOST, 5) for second in (10, 11, 15, 20, 21) for _ in range(3)]
    counts = [found.anomalous_seconds for found in feed(senders, rows) + senders.finish()]
    assert counts == [1, 2, 3, 3, 3]


def test_who_was_anomalous_long_ago_is_not_remembered():
    senders = trained_senders()
    feed(senders, [(5 + number // 4, HOST + number, 5) for number in range(100) for _ in range(3)])
    senders.finish()
    assert [identity[3][2] - HOST for identity in senders._history] == list(range(60, 100))


def test_the_open_second_is_closed_at_the_end():
    senders = trained_senders()
    feed(senders, [(5, HOST, 2)] * 3)
    assert len(senders.finish()) == 1
    assert senders.finish() == []


def test_senders_do_not_share_seconds():
    senders = trained_senders()
    assert feed(senders, [(5, HOST, 2), (5, HOST, 2), (5, OTHER, 2), (6, HOST, 0)]) == []


def test_evidence_is_that_of_the_highest_score_also_across_batches():
    senders = trained_senders()
    feed(senders, [(5, HOST, 2), (5, HOST, 9), (5, HOST, 3)])
    feed(senders, [(5, HOST, 4)])
    (found,) = senders.finish()
    assert found.tally.evidence == 1
    assert found.tally.peak == 9


def test_nan_and_infinite_scores_are_over_the_line():
    senders = trained_senders()
    feed(senders, [(5, HOST, np.nan), (5, HOST, np.inf), (5, HOST, 7)])
    assert len(senders.finish()) == 1


def test_late_packets_count_in_the_open_second_and_a_clock_set_back_starts_anew():
    senders = trained_senders()
    assert feed(senders, [(9, HOST, 2), (8, HOST, 2), (9, HOST, 2)]) == []
    (found,) = feed(senders, [(-10_000, HOST, 0)])
    assert (found.second, senders.clock_jumps) == (BASE_S + 9, 1)


def test_replies_of_a_flooded_host_heat_the_flooder():
    syn = blank(
        3,
        time_us=np.full(3, BASE_S * 1_000_000),
        ip_version=np.full(3, 4),
        ip_src_lo=np.full(3, HOST),
        ip_dst_lo=np.full(3, OTHER),
        tcp_sport=np.arange(3),
        tcp_dport=np.full(3, 80),
        tcp_flags=np.full(3, 2),
    )
    answer = RecordBatch(
        {
            **syn,
            "ip_src_lo": syn["ip_dst_lo"],
            "ip_dst_lo": syn["ip_src_lo"],
            "tcp_sport": syn["tcp_dport"],
            "tcp_dport": syn["tcp_sport"],
            "tcp_flags": np.full(3, 0x12, "u1"),
        }
    )
    senders = trained_senders()
    for batch in (syn, answer):
        senders.add(batch, "s1", scores=np.full(3, 9.0), trained=0, threshold=1.0, evidence=lambda row: row)
    (found,) = senders.finish()
    assert found.record.identity[3] == (4, 0, HOST)
    assert found.tally.packets == 6


def test_arp_speaks_for_its_sender_address():
    arp = blank(3, time_us=np.full(3, BASE_S * 1_000_000), arp_op=np.ones(3), arp_src_ip=np.full(3, HOST))
    senders = trained_senders()
    senders.add(arp, "s1", scores=np.full(3, 9.0), trained=0, threshold=1.0, evidence=lambda row: row)
    assert senders.finish()[0].record.identity[3] == (4, 0, HOST)


def test_state_goes_through_plain_values():
    senders = trained_senders()
    feed(senders, [(5, HOST, 0)])
    again = Senders.from_state(senders.to_state())
    assert feed(again, [(50, HOST, 3)] * 3) == []
    (found,) = again.finish()
    assert (found.record.training_rate, found.record.training_destinations) == (4, 3)


def test_spoofed_senders_are_forgotten(monkeypatch):
    monkeypatch.setattr("apps.kitsune.senders.MOST_SENDERS", 100)
    senders = trained_senders()
    for second in range(50):
        feed(senders, [(second * 20, 1_000 + 10 * second + number, 0) for number in range(10)])
    assert len(senders.known()) <= 120
    assert any(record.training_rate for record in senders.known())


def test_answers_to_a_blocked_sender_are_nobodys():
    """Its victim goes on answering a conversation that it began before the block; it has no part in that any more."""
    senders = trained_senders()
    sides = {
        "port": np.array([3, 4, 4, 4]),
        "eth_src": np.array([HOST, OTHER, OTHER, OTHER]) & 0xFF,
        "ip_version": np.full(4, 4),
        "ip_src_lo": np.array([HOST, OTHER, OTHER, OTHER]),
        "ip_dst_lo": np.array([OTHER, HOST, HOST, HOST]),
        "udp_sport": np.array([5000, 53, 53, 53]),
        "udp_dport": np.array([53, 5000, 5000, 5000]),
    }

    def second(at, scores):
        batch = blank(4, time_us=np.full(4, (BASE_S + at) * 1_000_000), **sides)
        how = {"trained": 0, "threshold": 1.0, "evidence": lambda row: row}
        return senders.add(batch, "s1", scores=np.array(scores, float), **how) + senders.finish()

    (found,) = second(5, [0, 2, 2, 2])
    assert found.record.identity[3] == (4, 0, HOST)
    address = ".".join(str(byte) for byte in HOST.to_bytes(4, "big"))
    for number, switch in enumerate(("s1", "*")):
        target = Target(kind="ip", address=address)
        senders.blocked.decide(decision(id=f"d{number}", switch=switch, target=target))
        batch = blank(4, time_us=np.full(4, (BASE_S + 6 + number) * 1_000_000), **sides).take(
            np.array([1, 2, 3])
        )
        how = {"trained": 0, "threshold": 1.0, "evidence": lambda row: row}
        assert senders.add(batch, "s1", scores=np.full(3, 2.0), **how) + senders.finish() == []
        senders.blocked.decide(decision(id=f"d{number}", action="unblock", switch=switch, target=target))
