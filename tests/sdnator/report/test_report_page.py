"""The page says in one sentence what happened, and never more than it knows."""

import pytest

from sdnator.report.report_page import render, verdict

BLOCK = {"address": "10.0.0.9", "time": "12:00", "packet": 5, "reason": "hot", "handle": "t[1]"}


@pytest.mark.parametrize(
    ("summary", "sentence"),
    [
        ({}, "Nothing to block: 0 alerts"),
        ({"alerts": 1}, "Nothing to block: 1 alert"),
        ({"alerts": 2, "mitigation": False}, "Kitsune alone, nothing blocked: 2 alerts"),
        ({"attack_packets": 9, "alerts": 2}, "The attack was not blocked: 9 attack packets, 2 alerts"),
        ({"blocks": [BLOCK]}, "1 sender blocked"),
        ({"blocks": [BLOCK, BLOCK, {**BLOCK, "address": "x"}]}, "2 senders blocked"),
        (
            {
                "blocks": [BLOCK],
                "time_to_block_s": {"capture": 4.25, "wall": 1.0},
                "attack_dropped": 999_999,
                "attack_after_first_block": 1_000_000,
                "benign_dropped": 0,
            },
            (
                "1 sender blocked 4.2 s after the first attack packet; "
                "99.9 % of the attack stopped from then on; nobody else was hit"
            ),
        ),
        (
            {"blocks": [BLOCK], "attack_dropped": 5, "attack_after_first_block": 5, "benign_dropped": 3},
            "1 sender blocked; 100 % of the attack stopped from then on; 3 benign packets were hit",
        ),
        ({"blocks": [BLOCK], "attack_dropped": 0, "attack_after_first_block": 0}, "1 sender blocked"),
    ],
)
def test_verdict(summary, sentence):
    assert verdict(summary) == sentence


def _page(**changes) -> str:
    fields = {
        "title": "t",
        "summary": {},
        "decisions": [],
        "incidents": [],
        "notes": [],
        "png": b"x",
        "passes": [],
    }
    return render(**(fields | changes))


def test_everything_from_outside_is_escaped():
    evil = "<img src=x onerror=alert(1)>"
    block = dict.fromkeys(BLOCK, evil)
    row = dict.fromkeys(("time", "action", "address", "state", "expires", "reason", "cause"), evil)
    page = _page(
        title=evil,
        summary={"blocks": [block], evil: 1},
        decisions=[row],
        notes=[evil],
        passes=[(evil, {evil: 1.0})],
    )
    assert evil not in page


def test_long_tables_end():
    row = dict.fromkeys(("time", "action", "address", "state", "expires", "reason", "cause"), "x")
    assert "and 50 more in decisions.csv" in _page(decisions=[row] * 250)
    assert "more in decisions.csv" not in _page(decisions=[row] * 200)


def test_figures_and_tiles():
    page = _page(
        summary={
            "packets_in": 160_000,
            "packets_lost": 1,
            "benign_dropped": 0,
            "collateral_dropped": 7,
            "auc": 0.98,
            "mitigation": True,
        },
        passes=[("alone", {"median score, attack": 8.5})],
    )
    for text in (
        "160,000",
        "class='tile bad'><b>1</b>",
        "class='tile good'><b>0</b>",
        "0.980",
        "8.5",
    ):
        assert text in page


def test_caption_says_what_passed_in_flight():
    """Where something was blocked."""
    block = dict.fromkeys(BLOCK, "x") | {"packet": 3}
    summary = {"blocks": [block], "passed_in_flight": 36, "most_in_flight": 1_075, "reaction_s": 0.5}
    page = _page(summary=summary)
    assert "36 packets of blocked senders passed in flight" in page
    assert "(0.5 s of capture time at most); 1,075 packets of all senders at most" in page
    assert "in flight:" not in _page(summary=summary | {"blocks": []})
