"""What passes before a block takes effect is counted for the block, and as nobody's success."""

from pathlib import Path

import numpy as np
import pytest

from apps.messages import Confirmation, Decision, Target
from sdnator.capture.captures import CaptureWriter
from sdnator.replay.passed_in_flight import InFlight
from sdnator.replay.survey import Survey, survey

SECOND = 1_000_000_000
MAC, OTHER = 0x020000000001, 0x020000000002


def surveyed() -> Survey:
    """A packet a second; every second one is of the sender 10.0.0.1."""
    nothing = np.zeros(10, np.uint32)
    macs = np.array([MAC, OTHER] * 5, np.uint64)
    addresses = np.array([0x0A000001, 0x0A000002] * 5, np.uint32)
    return Survey(
        Path("x.pcap"), np.arange(10) * SECOND, macs, addresses, 0, None, nothing, nothing, plain=True
    )


def block(target: Target, at: int = 3 * SECOND) -> Decision:
    return Decision(id="d1", action="block", switch="s1", target=target, reason="r", event_time=at, expires=0)


def answer(state: str = "installed") -> Confirmation:
    return Confirmation(id="d1", switch="s1", state=state, action="block", event_time=0)


@pytest.mark.parametrize(
    "target",
    [
        Target(kind="mac", address="02:00:00:00:00:01", port=1),
        Target(kind="ip", address="10.0.0.1"),
        Target(kind="ip", address="10.0.0.0/31"),
    ],
)
def test_packets_between_the_decision_and_its_effect(target):
    """Those of the blocked sender that passed; one that was dropped has not passed."""
    dropped = np.zeros(10, np.bool_)
    found = InFlight(surveyed(), [block(target)], [answer()], [8], dropped)
    assert (found.of_all, found.of_sender) == ({"d1": 4}, {"d1": 2})
    assert np.flatnonzero(found.packets).tolist() == [4, 6]
    dropped[6] = True
    assert InFlight(surveyed(), [block(target)], [answer()], [8], dropped).of_sender == {"d1": 1}


def test_a_block_that_nothing_overtook_has_nothing_in_flight():
    target = Target(kind="ip", address="10.0.0.1")
    nothing = np.zeros(10, np.bool_)
    assert InFlight(surveyed(), [block(target)], [answer()], [4], nothing).of_all == {"d1": 0}
    assert InFlight(surveyed(), [block(target)], [answer("failed")], [8], nothing).of_all == {}


def test_an_extension_is_no_new_block():
    target = Target(kind="ip", address="10.0.0.1")
    decisions = [block(target), block(target, 6 * SECOND)]
    found = InFlight(surveyed(), decisions, [answer(), answer()], [5, 9], np.zeros(10, np.bool_))
    assert found.of_all == {"d1": 1}


def test_ipv6_addresses_are_read_from_the_capture(tmp_path):
    path = tmp_path / "six.pcap"
    source = {
        1: bytes.fromhex("20010db8" + "00" * 11 + "01"),
        2: bytes.fromhex("20010db8" + "00" * 11 + "02"),
    }
    with CaptureWriter(path) as written:
        for second in range(6):
            header = b"\x60" + bytes(3) + b"\x00\x00\x3b\x40" + source[1 + second % 2] + source[2]
            written.write((100 + second) * SECOND, bytes(12) + b"\x86\xdd" + header, 54)
    at = 101 * SECOND
    decision = block(Target(kind="ip", address="2001:db8::1"), at)
    found = InFlight(survey(path), [decision], [answer()], [6], np.zeros(6, np.bool_))
    assert (found.of_all, found.of_sender) == ({"d1": 4}, {"d1": 2})
