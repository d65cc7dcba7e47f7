"""FastNetMon is given thresholds that no host of training reaches, and Debian's settings beside them."""

import numpy as np
import pytest

from benchmarks.decision_traffic.traffic import SECOND, Tape
from benchmarks.decisions_fastnetmon import DEBIANS, LEAST_PPS, _configuration, missing, thresholds_of

HOST, OUTSIDE = 0x0A000005, 0x08080808


def test_thresholds_are_half_as_much_again_as_training():
    """Of five-second means of a host of the network, whichever way packets go; outside hosts do not count."""
    tape = Tape()
    for at, count, protocol, source, target in (
        (0, 500, 6, HOST, OUTSIDE),
        (5, 1_000, 17, OUTSIDE, HOST),
        (10, 9_000, 17, OUTSIDE, OUTSIDE + 1),
    ):
        tape.add(
            at * SECOND + np.arange(count) * 4 * SECOND // count,
            ip_version=4,
            ip_proto=protocol,
            ip_src_lo=source,
            ip_dst_lo=target,
        )
    assert thresholds_of(tape.traffic(), 0x0A000000) == {
        "threshold_pps": 300,
        "threshold_tcp_pps": 150,
        "threshold_udp_pps": 300,
        "threshold_icmp_pps": LEAST_PPS,
    }


@pytest.mark.skipif(not DEBIANS.exists(), reason="FastNetMon is not installed")
def test_each_setting_stands_once_in_its_configuration(tmp_path):
    lines = _configuration(tmp_path, "10.0.0.0/24", {"threshold_pps": 300}).read_text().splitlines()
    assert sorted(line for line in lines if line.startswith(("threshold_pps", "interfaces "))) == [
        "interfaces = seen",
        "threshold_pps = 300",
    ]


def test_a_reason_is_given_where_it_cannot_run(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert "no program fastnetmon" in missing()
