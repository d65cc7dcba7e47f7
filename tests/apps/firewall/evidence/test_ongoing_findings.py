"""A finding that goes on is told when it begins, when it has doubled, and when it is over."""

import pytest
from msgspec import structs

from apps.firewall.evidence import ongoing_findings
from apps.firewall.evidence.ongoing_findings import BEGINNINGS, GROWTH, QUIET_S, OngoingFindings
from apps.firewall.policy.sequential_test import HALF_LIFE_S
from tests.apps.firewall.incidents.samples import SECOND, evidence


def flood(at_s: float, packets: int = 10, **changes):
    return evidence(at_s, None, kind="flood", source="flood", nats=8.0, packets=packets, **changes)


def told(made: OngoingFindings, *found, again: bool = False) -> list[tuple[int, float]]:
    """Packets and nats of the messages that are written."""
    written = []
    for each in found:
        whole, news = made.found(each, again=again)
        if news:
            made.told(whole)
            written.append((whole.packets, whole.nats))
    return written


def test_what_was_not_told_is_in_the_next_message():
    made = OngoingFindings()
    assert told(made, *[flood(100 + n) for n in range(8)]) == [
        (10, 8.0),
        (10, pytest.approx(0, abs=0.02)),
        (20, pytest.approx(0, abs=0.04)),
        (40, pytest.approx(0, abs=0.08)),
    ]
    whole, news = made.found(flood(108))
    assert (whole.since, whole.packets, news) == (round(99.5 * SECOND), 10, False)


def test_what_was_told_fades_as_it_does_where_it_is_added_up():
    made = OngoingFindings()
    told(made, flood(100))
    half = [flood(100 + n * QUIET_S, packets=1) for n in range(1, round(HALF_LIFE_S / QUIET_S))]
    assert told(made, *half) == []
    ((_, nats),) = told(made, flood(100 + HALF_LIFE_S, packets=10))
    assert nats == pytest.approx(4.0)


def test_another_look_at_the_same_packets_counts_only_those_that_have_come_since():
    made = OngoingFindings()
    told(made, flood(100, packets=100))
    assert made.found(flood(101, packets=130), again=True).evidence.packets == 30
    assert made.found(flood(101, packets=90), again=True).evidence.packets == 30
    assert told(made, flood(102, packets=100 * GROWTH), again=True) == [(100, pytest.approx(0, abs=0.1))]


def test_the_last_message_tells_what_is_left_and_weighs_nothing():
    made = OngoingFindings()
    told(made, flood(100), flood(101, packets=3))
    quiet = (101 + QUIET_S) * SECOND
    assert list(made.over(quiet)) == []
    (last,) = made.over(quiet + 1)
    assert (last.packets, last.nats, last.event_time) == (3, 0.0, 101 * SECOND)
    assert last.text.startswith("over, after 1.5 s and 13 packets: ")
    assert last.id == f"{flood(101).id}-over"
    assert list(made.over(quiet * 2)) == []
    assert told(made, flood(500)) == [(10, 8.0)]


def test_what_nobody_was_told_ends_in_silence():
    made = OngoingFindings()
    made.found(flood(100))
    assert list(made.over(1_000 * SECOND)) == []
    assert len(made) == 0


def test_the_longest_text_has_room_for_its_end():
    made = OngoingFindings()
    told(made, flood(100, text="x" * 4_096))
    (last,) = made.over(1_000 * SECOND)
    assert type(last).from_value(last.to_value()) == last


def test_many_names_within_a_second_fill_no_archive():
    """Those put off begin later, if they go on; what decides is told in any case."""
    made = OngoingFindings()
    many = [structs.replace(flood(100), service=f"tcp/{n}") for n in range(BEGINNINGS + 5)]
    assert len(told(made, *many)) == BEGINNINGS
    assert made.put_off == 5
    later = structs.replace(flood(101), service=f"tcp/{BEGINNINGS}")
    assert [packets for packets, _ in told(made, later)] == [20]


def test_findings_are_bounded(monkeypatch):
    monkeypatch.setattr(ongoing_findings, "MOST", 3)
    made = OngoingFindings()
    told(made, *[structs.replace(flood(100 + n), service=f"tcp/{n}") for n in range(9)])
    assert [each.service for each in made.over(1_000 * SECOND)] == ["tcp/6", "tcp/7", "tcp/8"]
