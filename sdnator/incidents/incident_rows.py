"""An incident as one row, the same in `sdnator incidents`, in the report of a replay and on the page.  Pure."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from msgspec import structs

from apps.evidence import Kind
from apps.incidents import REMEDY_WORDS, Incident, IncidentAction, IncidentCost
from sdnator.notation import local_time
from sdnator.plurals import counted

KINDS: Final[dict[Kind, str]] = {
    "scan": "scan",
    "flood": "flood",
    "guessing": "password guessing",
    "spoofing": "spoofing",
    "unlike_training": "unlike training",
    "offence": "earlier offence",
    "other": "other",
}
_DONE: Final = {"block": "blocked", "guard": "guarded", "meter": "rate limited"}
_VICTIMS_NAMED: Final = 2


def newest_of_each(incidents: Iterable[Incident]) -> list[Incident]:
    """Each incident as last reported, in the order of their begin.

    Args:
        incidents: reports in the order of writing.

    Returns:
        Incidents without those that turned out to be a part of another.
    """
    last = {each.id: each for each in incidents}
    return sorted((each for each in last.values() if not each.joined), key=lambda each: (each.begun, each.id))


def with_counters(incident: Incident, packets: Mapping[str, int]) -> Incident:
    """The incident with newer counters of its decisions.

    Args:
        incident: as last reported.
        packets: last drop counter by decision.
    """
    actions = tuple(
        structs.replace(each, packets=max(each.packets, packets.get(each.decision, 0)))
        for each in incident.actions
    )
    more: Counter[str] = Counter()
    for before, after in zip(incident.actions, actions, strict=True):
        more[after.remedy] += after.packets - before.packets
    cost = incident.cost
    counted_up = IncidentCost(
        dropped=cost.dropped + more["block"],
        challenged=cost.challenged + more["guard"],
        metered=cost.metered + more["meter"],
    )
    return structs.replace(incident, actions=actions, cost=counted_up)


def as_json(incident: Incident) -> dict[str, Any]:
    """All fields of the message, and what follows from them.

    Returns:
        Plain values; `mitigated`, `mitigated_after_s`, `done` and `packets_stopped` are added.
    """
    return incident.to_value() | {
        "mitigated": incident.mitigated,
        "mitigated_after_s": incident.mitigated_after_s,
        "done": done_words(incident),
        "packets_stopped": incident.cost.stopped,
    }


def row(incident: Incident) -> dict[str, str]:
    """Texts for one row: time, kind, attacker, victims, what was done, packets stopped."""
    return {
        "id": incident.id,
        "time": local_time(incident.begun),
        "kind": KINDS[incident.kind],
        "attacker": short_attacker(incident),
        "victims": victims_words(incident),
        "done": done_words(incident),
        "stopped": f"{incident.cost.stopped:,}",
        "state": incident.state,
    }


def short_attacker(incident: Incident) -> str:
    """The attacker's address, or the words of the incident."""
    sender = incident.attacker
    if sender is None:
        return incident.attacker_text
    name = sender.ip or sender.mac
    return f"{name} and {incident.attacker_count - 1:,} more" if incident.attacker_count > 1 else name


def victims_words(incident: Incident) -> str:
    """The first victims, how many more there are, and the service."""
    named = incident.victims[:_VICTIMS_NAMED]
    more = max(incident.victim_count, len(incident.victims)) - len(named)
    text = ", ".join(named) + (f" and {more:,} more" if more > 0 and named else "")
    text = text or (counted(incident.victim_count, "host") if incident.victim_count else "-")
    return f"{text} {incident.service}" if incident.service else text


def done_words(incident: Incident) -> str:
    """What was done, in words; several targets of one remedy are counted."""
    targets: dict[str, list[str]] = {}
    for action in incident.actions:
        targets.setdefault(action_words(action), []).append(action.target)
    left_out = incident.action_count - len(incident.actions)
    parts = [_about(words, names) for words, names in targets.items()]
    if left_out > 0:
        parts.append(f"{counted(left_out, 'decision')} before")
    return "; ".join(parts) or "nothing"


def _about(words: str, targets: list[str]) -> str:
    if words.startswith("alert only"):
        return words
    head, comma, tail = words.partition(",")
    return f"{head} {targets[0] if len(targets) == 1 else counted(len(targets), 'target')}{comma}{tail}"


def action_words(action: IncidentAction) -> str:
    """An action in words: `blocked`, `blocked, over`, `would block`, `block, refused by the switch`."""
    if action.remedy == "alert":
        return f"alert only: {action.reason}" if action.reason else "alert only"
    remedy = REMEDY_WORDS.get(action.remedy, action.remedy)
    if action.dry_run:
        return f"would {remedy}"
    if action.state == "failed":
        return f"{remedy}, refused by the switch"
    if not action.effective:
        return f"{remedy}, {'not confirmed' if action.state == 'decided' else 'lifted'}"
    return f"{_DONE[action.remedy]}{', over' if action.state == 'over' else ''}"


def as_text(incident: Incident) -> Iterator[str]:
    """Everything about an incident in lines."""
    yield f"incident {incident.id}: {KINDS[incident.kind]}, {incident.state}"
    if incident.joined:
        yield f"it is a part of incident {incident.joined}"
    yield f"attacker: {incident.attacker_text}"
    yield f"victims: {victims_words(incident)}"
    seconds = (incident.last - incident.begun) / 1e9
    yield f"time: {local_time(incident.begun)} to {local_time(incident.last)} ({seconds:,.1f} s)"
    first = f", from arrival number {incident.first_packet:,}" if incident.first_packet else ""
    yield f"packets: {incident.packets:,}{first}"
    if incident.bound:
        yield f"sum: {incident.nats:.1f} nats, bound {incident.bound:.1f}; the highest was {incident.peak_nats:.1f}"
    yield "evidence, the newest:"
    for piece in incident.evidence:
        weight = f", {piece.nats:.1f} nats" if piece.nats else ""
        yield f"  {local_time(piece.event_time)} {piece.source}{weight}: {piece.text}"
    yield f"done: {done_words(incident)}"
    for action in incident.actions:
        end = f" until {local_time(action.until)}" if action.until else ""
        name = f" (decision {action.decision})" if action.decision else ""
        yield (
            f"  {local_time(action.since)} {action_words(action)} {action.target}{end}, "
            f"{counted(action.packets, 'packet')}{name}"
        )
    cost = incident.cost
    yield (
        f"packets stopped: {cost.dropped:,} dropped, {cost.challenged:,} challenged, {cost.metered:,} over rate limits"
    )
