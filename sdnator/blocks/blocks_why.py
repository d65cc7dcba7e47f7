"""A decision's whole life for people: what led to it, what the archive knew, what the switches did."""

from collections.abc import Collection, Iterator
from typing import Any

from msgspec import structs

from apps.enforcement import CONFIRMED, ENFORCED
from apps.firewall.evidence.history import DECISIONS, count_offences, instructions_in, offences_query
from apps.messages import Decision, Exhibit, Ground, writer_of
from due import Item
from sdnator.blocks.blocks_archive import find
from sdnator.blocks.blocks_places import PlaceAnswer, action_word, last_answers, places_words
from sdnator.blocks.decision_summary import five_lines
from sdnator.blocks.lessons import ground_words, lesson_lines, lessons_in_force
from sdnator.errors import BadInput
from sdnator.incidents.incidents_archive import incident_of
from sdnator.notation import local_time
from sdnator.plurals import counted

_SHOWN = 200


def life_of(decision_id: str, archive: str) -> dict[str, Any]:
    """Everything that the archive has about a decision; raises `BadInput` where there is none."""
    found = [each for key in DECISIONS for each in find(archive, {"dataKey": key, "value.id": decision_id})]
    if not found:
        raise BadInput(f"no decision has the id {decision_id}; see `sdnator blocks list --all`")
    steps = [Decision.from_value(item.value) for item in found]
    first = steps[0]
    earlier = find(archive, offences_query(first.target))
    confirmations = find(archive, {"dataKey": f"{CONFIRMED}.*.*", "value.id": decision_id})
    answers = last_answers(confirmations).get(decision_id, ())
    incident = incident_of(archive, decision_id)
    lessons = lessons_in_force(archive)
    return {
        "id": decision_id,
        "why": list(five_lines(first, steps[-1], incident, places_words(steps[-1], answers))),
        "incident": incident.to_value() if incident is not None else None,
        "target": first.target.address,
        "steps": [
            {"written": item.timestamp} | made.to_value() for item, made in zip(found, steps, strict=True)
        ],
        "evidence": [_evidence(each, archive) for each in dict.fromkeys(_all_evidence(steps))],
        "offences_before": count_offences(
            earlier, first.target, first.event_time, {each.id for each in lessons}
        ),
        "false_alarm": [line for each in lessons if each.id == decision_id for line in lesson_lines(each)],
        "counted_less": [
            f"{ground_words(ground)}: {each.id} was called a false alarm"
            for each in lessons
            for ground in each.grounds
            if each.id != decision_id and _same(ground) in {_same(mine) for mine in first.grounds}
        ],
        "confirmations": [
            {"written": item.timestamp, "enforcer": writer_of(item.key)} | dict(item.value)
            for item in confirmations
        ],
        "enforcers": [answer.to_value() for answer in answers],
        "stopped": _stopped(decision_id, archive),
        "events": [
            {"written": item.timestamp} | dict(item.value)
            for item in find(archive, "network.event.firewall.*")
            if decision_id in str(item.value.get("text", ""))
        ],
    }


def _same(ground: Ground) -> Ground:
    """Without its weight, which differs from time to time."""
    return structs.replace(ground, nats=0.0)


def _all_evidence(steps: list[Decision]) -> Iterator[Exhibit]:
    for step in steps:
        yield from step.evidence


def _evidence(evidence: Exhibit, archive: str) -> dict[str, Any]:
    """With what the archive has of it: alerts and instructions are kept, packets are not."""
    items = find(archive, {"dataKey": evidence.key, "timestamp": evidence.timestamp})
    asked = instructions_in(items)
    who = {"reason_given": asked[0].reason} if asked else {}
    return evidence.to_value() | {"archived": bool(items)} | who


def _stopped(decision_id: str, archive: str) -> dict[str, dict[str, int]]:
    """By place: the last reading of the decision's drop counter."""
    last: dict[str, dict[str, int]] = {}
    for key in ("network.switch.p4runtime_ctrl.*", f"{ENFORCED}.*.*"):
        for item in find(archive, {"dataKey": key, "value.blocks.id": decision_id}):
            where = str(item.value.get("switch") or f"{item.app_id} {item.value.get('place')}")
            for reading in _readings(item, decision_id):
                last[where] = reading
    return last


def _readings(item: Item, decision_id: str) -> Iterator[dict[str, int]]:
    for reading in item.value.get("blocks", ()):
        if reading["id"] == decision_id:
            yield {name: int(reading[name]) for name in ("packets", "bytes", "seen") if name in reading}


def as_text(life: dict[str, Any]) -> Iterator[str]:
    """Five lines that explain it, then its life in the order of what happened."""
    yield from life["why"]
    yield ""
    yield from life["false_alarm"]
    yield from (f"counted less: {text}" for text in life["counted_less"])
    if life["incident"] is not None:
        yield f"part of incident {life['incident']['id']}: `sdnator incidents show {life['incident']['id']}`"
    events: list[tuple[int, str]] = []
    for step in life["steps"]:
        made = Decision.from_value(step)
        events.append((step["written"], decision_line(made)))
    for said in life["confirmations"]:
        words = f"{said['state']} {said['handle']} {said['cause']}"
        where = PlaceAnswer(said["enforcer"], said["switch"], "", "").where()
        events.append((said["written"], f"  {where}: {words}".rstrip()))
    events += [(said["written"], f"  {said['text']}") for said in life["events"]]
    yield from (f"{local_time(at)} {text}" for at, text in sorted(events, key=lambda event: event[0]))
    before = life["offences_before"]
    yield f"blocked before: {counted(before, 'time')}" if before else "blocked before: never"
    yield "evidence:" if life["evidence"] else "evidence: none, the settings name it"
    for each in life["evidence"]:
        kept = "" if each["archived"] else " (not kept in the archive)"
        yield f"  {local_time(each['timestamp'])} {each['key']}: {each['summary'][:_SHOWN]}{kept}"
    for switch, reading in life["stopped"].items():
        passed = f"; {reading['seen'] - reading['packets']:,} passed" if "seen" in reading else ""
        yield f"stopped by {switch}: {counted(reading['packets'], 'packet')}, {counted(reading['bytes'], 'byte')}{passed}"


def decision_line(decision: Decision, answers: Collection[PlaceAnswer] | None = None) -> str:
    """A decision in one line.

    Args:
        decision: the decision.
        answers: what enforcers said of it last; None: that is told elsewhere.
    """
    until = f"until {local_time(decision.expires)}" if decision.expires else "without end"
    if answers is None:
        return (
            f"{decision.id} {decision.doing} {decision.what} on {decision.switch} {until}: {decision.reason}"
        )
    action, places = action_word(decision, answers), places_words(decision, answers)
    return (
        f"{decision.id} {action} {decision.what} on {decision.switch} {until} ({places}): {decision.reason}"
    )
