"""The message about an incident: what comes from outside is whole, or refused with one error."""

import pytest
from hypothesis import given, settings

from apps.incidents import Incident, IncidentAction
from apps.messages import MessageError
from tests.apps import hostile

WHOLE = {
    "id": "i1", "kind": "scan", "change": "opened", "attacker_text": "192.0.2.66", "begun": 10, "last": 20,
    "event_time": 20, "victims": ["192.0.2.1"],
}  # fmt: skip


@settings(max_examples=150, deadline=None)
@given(hostile.values)
def test_no_value_breaks_the_decoder(value):
    for tried in (
        value,
        {**WHOLE, "actions": value},
        {**WHOLE, "attacker": value},
        {**WHOLE, "evidence": value},
    ):
        try:
            read = Incident.from_value(tried)
        except MessageError:
            continue
        assert read.begun <= read.last


@pytest.mark.parametrize(
    "wrong",
    [
        {"begun": 30},
        {"victims": ["nobody"]},
        {"victims": [f"192.0.2.{number}" for number in range(17)]},
        {"kind": "war"},
        {"nats": -1.0},
        {"nats": float("nan")},
        {"attacker": {"switch": "s1", "port": 1, "mac": "x"}},
    ],
    ids=str,
)
def test_impossible_incidents_are_refused(wrong):
    assert Incident.from_value(WHOLE).kind == "scan"
    with pytest.raises(MessageError):
        Incident.from_value(WHOLE | wrong)


def test_mitigated_means_in_force_within_five_seconds():
    """The first remedy that a switch carries out counts, from the first packet on."""
    second = 1_000_000_000
    late = IncidentAction(remedy="block", since=1, effective=7 * second)
    soon = IncidentAction(remedy="guard", since=2, effective=5 * second)
    fields = {"id": "i", "kind": "scan", "change": "over", "attacker_text": "", "begun": 0}
    times = {"last": 9 * second, "event_time": 9 * second}
    both = Incident(**fields, **times, actions=(late, soon))
    assert both.mitigated_after_s == 5.0
    assert both.mitigated
    assert not Incident(**fields, **times, actions=(late,)).mitigated
    assert not Incident(**fields, **times).mitigated
