"""One row says who, whom, what was done and what it stopped, and never more than is known."""

import pytest
from msgspec import structs

from apps.incidents import Incident, IncidentAction
from sdnator.incidents.incident_rows import (
    action_words,
    as_json,
    as_text,
    done_words,
    newest_of_each,
    row,
    short_attacker,
    victims_words,
    with_counters,
)
from tests.sdnator.incidents.samples import life


def incident(**changes) -> Incident:
    return structs.replace(life()[-1], **changes)


def action(**changes) -> IncidentAction:
    return IncidentAction(
        **({"remedy": "block", "since": 5, "decision": "d", "target": "192.0.2.1"} | changes)
    )


def test_a_row():
    *_, over = life()
    texts = row(over)
    assert (texts["kind"], texts["attacker"], texts["victims"]) == (
        "scan",
        "192.168.2.108",
        "192.168.2.50 tcp/22",
    )
    assert (texts["done"], texts["stopped"]) == ("blocked 5c:cf:7f:05:f2:c6 port 1, over", "70")
    assert texts["time"].startswith(("1970-01-01", "1969-12-31"))
    assert as_json(over)["mitigated"]
    assert as_json(over)["packets_stopped"] == 70


@pytest.mark.parametrize(
    ("one", "words"),
    [
        (action(), "block, not confirmed"),
        (action(effective=6, state="in_force"), "blocked"),
        (action(effective=6, state="over"), "blocked, over"),
        (action(state="over"), "block, lifted"),
        (action(state="failed"), "block, refused by the switch"),
        (action(dry_run=True, effective=6, state="in_force"), "would block"),
        (action(remedy="guard", effective=6, state="in_force"), "guarded"),
        (action(remedy="meter", effective=6, state="in_force"), "rate limited"),
        (action(remedy="alert", reason="it is the gateway"), "alert only: it is the gateway"),
    ],
    ids=str,
)
def test_what_was_done_is_said_as_it_is(one, words):
    """Nothing counts as blocked that no switch has confirmed."""
    assert action_words(one) == words


def test_several_targets_are_counted():
    many = tuple(action(target=f"192.0.2.{number}", effective=6, state="in_force") for number in range(3))
    done = done_words(incident(actions=(*many, action(remedy="alert")), action_count=9))
    assert done == "blocked 3 targets; alert only; 5 decisions before"
    assert done_words(incident(actions=(), action_count=0)) == "nothing"


def test_who_and_whom():
    several = incident(
        attacker_count=4, victims=("10.0.0.1", "10.0.0.2", "10.0.0.3"), victim_count=90, service=""
    )
    assert short_attacker(several) == "192.168.2.108 and 3 more"
    assert victims_words(several) == "10.0.0.1, 10.0.0.2 and 88 more"
    assert victims_words(incident(victims=(), victim_count=7, service="arp")) == "7 hosts arp"
    assert short_attacker(incident(attacker=None, attacker_text="forged")) == "forged"


def test_the_last_report_holds_and_parts_of_others_are_left_out():
    reports = life()
    part = incident(id="part", joined=reports[0].id)
    assert newest_of_each([*reports, part]) == [reports[-1]]


def test_newer_counters_win():
    after = with_counters(incident(), {"d1": 75, "other": 9})
    assert (after.cost.dropped, after.actions[0].packets) == (75, 75)
    assert with_counters(incident(), {"d1": 1}).cost.dropped == 70


def test_all_of_it_as_text():
    lines = list(as_text(incident()))
    text = "\n".join(lines)
    assert lines[0].endswith("scan, over")
    for words in (
        "sum: 10.0 nats, bound 10.0",
        "strangers, 6.0 nats: SYNs to 20 hosts",
        "70 dropped",
        "decision d1",
    ):
        assert words in text
