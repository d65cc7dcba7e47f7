"""The figures of a replay."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.messages import Confirmation, Decision, Target
from sdnator.capture.labels import Labels
from sdnator.replay.packet_accounting import PacketAccounting, PacketState
from sdnator.replay.summary import attack_figures, block_rows, from_attackers, roc_auc
from sdnator.replay.survey import Survey

CAMERA, PHONE = 0x5CCF7F05F2C6, 0x111111111111
SECOND = 1_000_000_000


def surveyed(*macs: int) -> Survey:
    count = len(macs)
    return Survey(
        Path("x.pcap"),
        np.arange(count, dtype=np.int64) * SECOND,
        np.array(macs, np.uint64),
        np.zeros(count, np.uint32),
        0,
        None,
        np.zeros(count, np.uint32),
        np.zeros(count, np.uint32),
        True,
    )


def naive_auc(attack, score):
    pairs = [
        (p, n)
        for p, a in zip(score, attack, strict=True)
        if a
        for n, b in zip(score, attack, strict=True)
        if not b
    ]
    return sum(1.0 if p > n else 0.5 if p == n else 0.0 for p, n in pairs) / len(pairs) if pairs else None


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 5)), max_size=40))
def test_auc_equals_counting_pairs(rows):
    """The rank formula is the share of pairs in the right order, ties counted half."""
    attack = np.array([a for a, _ in rows], np.bool_)
    score = np.array([s for _, s in rows], np.float64)
    expected = naive_auc(attack.tolist(), score.tolist())
    assert roc_auc(attack, score) == (None if expected is None else pytest.approx(expected))


def test_dropped_packets_are_told_apart():
    """Attack, an attacker's own benign packets, and innocent ones."""
    survey = surveyed(CAMERA, CAMERA, PHONE, CAMERA)
    labels = Labels.of([False, True, False, True], ["", "5c:cf:7f:05:f2:c6", "", "5c:cf:7f:05:f2:c6"])
    flight = PacketAccounting(4)
    flight.send(4)
    flight.state[:] = PacketState.DROPPED
    found = attack_figures(survey, labels, flight, {"packet": 2, "time": 2.5})
    assert (found["attack_dropped"], found["collateral_dropped"], found["benign_dropped"]) == (2, 1, 1)
    assert found["attack_after_first_block"] == 1
    assert found["time_to_block_capture_s"] == pytest.approx(1.5)


def test_unnamed_attackers_are_the_senders_of_attack_packets():
    """The published label file names nobody."""
    labels = Labels.of([False, True, False])
    assert from_attackers(surveyed(CAMERA, CAMERA, PHONE), labels).tolist() == [True, True, False]


def test_block_row_counts_what_the_switch_installed():
    """A decision that failed is no block; an extension is the same block."""
    target = Target(kind="mac", address="5c:cf:7f:05:f2:c6", port=1)
    first = Decision(
        id="a",
        action="block",
        switch="s1",
        target=target,
        reason="hot",
        event_time=SECOND,
        expires=2 * SECOND,
    )
    extended = Decision(
        id="a",
        action="block",
        switch="s1",
        target=target,
        reason="still",
        event_time=2 * SECOND,
        expires=3 * SECOND,
    )
    failed = Decision(
        id="b",
        action="block",
        switch="s1",
        target=target,
        reason="hot",
        event_time=SECOND,
        expires=2 * SECOND,
    )
    confirmations = [
        Confirmation(
            id="a", switch="s1", state="installed", action="block", handle="h", event_time=SECOND, arrival=9
        ),
        Confirmation(id="b", switch="s1", state="failed", action="block", event_time=SECOND),
        Confirmation(id="a", switch="s1", state="exists", action="block", event_time=2 * SECOND),
    ]
    rows = block_rows(surveyed(*[CAMERA] * 12), [first, extended, failed], confirmations)
    assert [(row["id"], row["reason"], row["packet"], row["time"]) for row in rows] == [("a", "hot", 9, 9.0)]
