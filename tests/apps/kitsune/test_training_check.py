"""An attack in the training traffic is said; ordinary training says nothing."""

import numpy as np

from apps.kitsune.senders import SenderRecord
from apps.kitsune.training_check import TrainingCheck
from sdnator.testing.packet_rows import blank


def record(number, rate, hosts=1):
    identity = ("s1", 1, number, (4, 0, 0xC0A80200 + number))
    return SenderRecord(identity, training_rate=rate, training_destinations=hosts)


def syns(count, seconds):
    return blank(
        count,
        time_us=(np.arange(count) * seconds * 1_000_000) // count,
        tcp_sport=np.arange(count) % 60_000,
        tcp_dport=np.full(count, 80),
        tcp_flags=np.full(count, 0xC2),
    )


def test_quiet_training_says_nothing():
    check = TrainingCheck()
    check.see(syns(300, 60), 300)
    assert check.warnings([record(1, 30), record(2, 12), record(3, 1)]) == []
    assert TrainingCheck().warnings([]) == []


def test_a_flood_a_scan_and_a_syn_flood_are_named():
    check = TrainingCheck()
    check.see(syns(900, 2), 900)
    flood, scan, syn = check.warnings([record(1, 4000), record(2, 10, hosts=200), record(3, 5)])
    assert flood.startswith("192.168.2.1 sent 4000 packets")
    assert scan.startswith("192.168.2.2 addressed 200 hosts")
    assert "SYN flood" in syn


def test_only_training_rows_count():
    check = TrainingCheck()
    check.see(syns(900, 2), 10)
    assert check.warnings([]) == []
