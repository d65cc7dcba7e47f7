"""What the service publishes of incidents: items under the kind's key, lines for SIEMs, the same after a restart."""

import json
import time

from apps.firewall.incidents.incident_reports import IncidentReports
from apps.incidents import Incident
from due import Item
from tests.apps.firewall.alerts import SECOND, alert
from tests.apps.firewall.desk import ALERT, NOW, SWITCH, Desk, FakeEngine
from tests.apps.firewall.incidents.samples import BOUND, confirmation, decision, evidence

KEY = "network.incident.firewall."


class Lines:
    """Takes the place of `Announcer`."""

    def __init__(self) -> None:
        self.taken: list[tuple[str, bool]] = []

    def event(self, line: str, *, important: bool = False) -> None:
        self.taken.append((line, important))


def reports(engine: FakeEngine, **options: str) -> tuple[IncidentReports, Lines]:
    lines = Lines()
    return IncidentReports(engine, lines, **options), lines  # type: ignore[arg-type]


def incidents(desk: Desk) -> list[Incident]:
    return [Incident.from_value(value) for value in desk.written(KEY)]


def test_evidence_and_decisions_become_items_and_lines():
    """Each report under its kind's key; a line but for updates; the webhook hears of decisions and ends."""
    engine = FakeEngine()
    told, lines = reports(engine)
    told.evidence(evidence(), 7.0, BOUND)
    told.spared(evidence(100.1), 12.0, BOUND, "it is the gateway")
    told.decided(decision())
    told.confirmed(confirmation())
    told.count("d1", 9, 103 * SECOND)
    told.lapse(5000 * SECOND)
    assert {key for key, _ in engine.written} == {f"{KEY}scan"}
    assert [value["change"] for _, value in engine.written] == [
        *("opened", "decided", "decided", "confirmed", "more", "over")
    ]
    assert [important for _, important in lines.taken] == [False, True, True, False, True]
    told.flush()
    assert told.health() == {
        "incidents_open": 0,
        "suspicions": 0,
        "incident_reports": 6,
        "incident_openings_put_off": 0,
    }


def test_a_decision_of_no_incident_has_its_own_line():
    """In the fields of the Elastic Common Schema, where the settings say so."""
    told, lines = reports(FakeEngine(), form="ecs")
    told.decided(decision(evidence=()))
    ((line, important),) = lines.taken
    assert json.loads(line)["rule"]["name"] == "SDNATOR block"
    assert important


def test_the_service_tells_its_incidents_and_goes_on_after_a_restart():
    """Alert, block, confirmation, drops: one id, also for a firewall that starts anew on the same archive."""
    desk = Desk(detect=False)
    desk.hand(ALERT, alert(NOW // SECOND, anomalous_seconds=5).to_value())
    desk.confirm(desk.decisions[0])
    states = "network.switch.p4runtime_ctrl.*"
    counters = [{"id": desk.decisions[0].id, "packets": 40}]
    for second in (2, 4):
        at = NOW + second * SECOND
        value = {"switch": "s1", "primary": True, "event_time": at, "blocks": counters}
        desk.hand(SWITCH, value, pattern=states, at=at)
    told = incidents(desk)
    assert [each.change for each in told] == ["opened", "decided", "confirmed", "more"]
    assert len({each.id for each in told}) == 1
    assert (told[-1].kind, told[-1].mitigated, told[-1].cost.dropped) == ("unlike_training", True, 40)
    assert desk.service.health()["incidents_open"] == 1

    engine = FakeEngine()
    engine.archived = [
        Item(key, value, time.time_ns() + number, NOW, "firewall", "i1", number)
        for number, (key, value) in enumerate(desk.engine.written, 1)
    ]
    engine.archived.append(Item(f"{KEY}scan", {"id": 5}, time.time_ns(), NOW, "firewall", "i1", 99))
    again = Desk(detect=False, engine=engine)
    assert again.service.health()["incidents_open"] == 1
    again.hand(ALERT, alert(NOW // SECOND + 9).to_value())
    assert {each.id for each in incidents(again)} == {told[0].id}


def test_a_switch_with_a_wrong_clock_ends_no_incident():
    """Its confirmation counts from now on, and nobody's time moves."""
    engine = FakeEngine()
    told, _ = reports(engine)
    told.evidence(evidence(), 7.0, BOUND)
    told.decided(decision())
    told.confirmed(confirmation(10**8))
    told.evidence(evidence(102.5), 8.0, BOUND)
    last = Incident.from_value(engine.written[-1][1])
    assert last.actions[0].effective == 101 * SECOND
    assert told.health()["incidents_open"] == 1
