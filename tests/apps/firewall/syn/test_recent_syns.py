"""SYNs of the last moments: found by host and time, and not too many of them."""

import ipaddress

import numpy as np
import pytest

from apps.firewall.syn.recent_syns import RecentSyns, Surges
from due import RecordBatch


def batch(*rows: tuple[int, str, str, int]) -> RecordBatch:
    """Rows of time in us, source, destination, port."""
    sources = [ipaddress.ip_address(row[1]) for row in rows]
    targets = [ipaddress.ip_address(row[2]) for row in rows]
    halves = {
        name: np.array([int(each) >> shift & (1 << 64) - 1 for each in addresses], np.uint64)
        for name, addresses, shift in (
            ("ip_src_hi", sources, 64),
            ("ip_src_lo", sources, 0),
            ("ip_dst_hi", targets, 64),
            ("ip_dst_lo", targets, 0),
        )
    }
    return RecordBatch(
        halves
        | {
            "time_us": np.array([row[0] for row in rows], np.int64),
            "ip_version": np.array([each.version for each in sources], np.uint8),
            "tcp_dport": np.array([row[3] for row in rows], np.int32),
        }
    )


def test_found_by_host_and_time():
    """IPv4 and IPv6 hosts of the same number are told apart."""
    recent = RecentSyns(100)
    recent.add(batch((1, "10.0.0.5", "0.0.0.1", 80), (2, "10.0.0.6", "0.0.0.1", 81)))
    recent.add(batch((3, "2001:db8::5", "::1", 443), (4, "10.0.0.5", "10.0.0.9", 80)))
    assert list(recent.towards("0.0.0.1", 2_000)) == [(81, "10.0.0.6")]
    assert list(recent.towards("::1", 0)) == [(443, "2001:db8::5")]


def test_memory_is_bounded():
    """Old batches go when enough newer rows are there."""
    recent = RecentSyns(10)
    for at in range(1000):
        recent.add(batch(*[(at, "10.0.0.5", "10.0.0.1", 80)] * 4))
    assert 10 <= len(recent) < 14
    assert len(list(recent.towards("10.0.0.1", 0))) == len(recent)


def test_a_surge_is_said_once_a_window():
    """Whichever batch brings the SYN that makes it one."""
    surges = Surges(10, 200)
    row = (1_000_000, "10.0.0.5", "10.0.0.1", 80)
    other = (1_000_000, "2001:db8::5", "2001:db8::1", 80)
    assert surges.add(batch(*[row] * 9, other)) == []
    assert surges.add(batch(row)) == [("10.0.0.1", 1_000_000_000, 1_000_000_000)]
    assert surges.add(batch(*[row] * 30)) == []
    assert surges.add(batch(*[other] * 9)) == [("2001:db8::1", 1_000_000_000, 1_000_000_000)]
    assert surges.add(batch(*[(1_200_000, *row[1:])] * 10)) == [("10.0.0.1", 1_200_000_000, 1_200_000_000)]


@pytest.mark.parametrize("rows", [1, 7, 64])
def test_surges_do_not_depend_on_how_syns_are_divided_into_batches(rows):
    """A replay at full speed brings many windows in a batch, a live switch a part of one."""
    syns = [(1_000_000 + 1_500 * number, "10.0.0.5", f"10.0.0.{number % 2}", 80) for number in range(400)]
    apart, whole = Surges(40, 200), Surges(40, 200)
    found = [each for first in range(0, 400, rows) for each in apart.add(batch(*syns[first : first + rows]))]
    assert found == whole.add(batch(*syns))
    assert found[0] == ("10.0.0.0", 1_000_000_000, (1_000_000 + 1_500 * 78) * 1_000)
    assert len(found) == 6


def test_slow_syns_are_no_surge():
    """Nine in each window of two hundred milliseconds."""
    surges = Surges(10, 200)
    for window in range(20):
        assert surges.add(batch(*[(window * 200_000, "10.0.0.5", "10.0.0.1", 80)] * 9)) == []
    assert surges.add(RecordBatch({"time_us": np.array([], np.int64)})) == []
