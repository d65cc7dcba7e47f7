"""Why there is a decision, in five lines: sum and bound, contributions, remedy, end, how to undo.  Pure."""

from collections.abc import Iterator

from apps.incidents import Incident, IncidentAction
from apps.messages import Decision, one_line
from sdnator.incidents.incident_rows import action_words
from sdnator.notation import local_time

_LARGEST = 3
_WORDS = 100
"""Characters of a text in a line; what follows a semicolon is detail, which the history below has."""


def five_lines(first: Decision, last: Decision, incident: Incident | None, places: str = "") -> Iterator[str]:
    """Explain a decision.

    Args:
        first: as it was made.
        last: as it is now: extended or lifted, perhaps.
        incident: the incident that it belongs to, as last reported; None if it belongs to none.
        places: where it is in force, in words; empty: unknown.

    Yields:
        Five lines.
    """
    action = _action(first, incident)
    yield f"sum: {_sum(first, action)}"
    yield f"largest contributions: {_contributions(first, action)}"
    where = f" ({places})" if places and not _is_lifted(last) else ""
    yield f"remedy: {_remedy(first, last, action)}{where}"
    yield f"until: {_until(last)}"
    yield f"undo: {_undo(first, last)}"


def _action(decision: Decision, incident: Incident | None) -> IncidentAction | None:
    actions = incident.actions if incident is not None else ()
    return next((each for each in actions if each.decision == decision.id), None)


def _sum(decision: Decision, action: IncidentAction | None) -> str:
    if action is not None and action.bound:
        return f"{action.nats:.1f} nats of evidence; the bound was {action.bound:.1f}"
    return f"none, another rule decided: {_short(decision.reason)}"


def _contributions(decision: Decision, action: IncidentAction | None) -> str:
    shares = action.contributions if action is not None else ()
    if shares:
        return "; ".join(
            f"{each.source} {each.nats:.1f} nats ({_short(each.text)})" for each in shares[:_LARGEST]
        )
    told = dict.fromkeys(_short(each.summary) for each in reversed(decision.evidence))
    return "; ".join(list(told)[:_LARGEST]) or "none, the settings name it"


def _remedy(first: Decision, last: Decision, action: IncidentAction | None) -> str:
    switch = "all switches" if first.switch in ("", "*") else first.switch
    done = action_words(action) if action is not None else first.doing.replace("protect", "guard")
    lifted = f", lifted: {one_line(last.reason)}" if _is_lifted(last) else ""
    return f"{done} {first.what} on {switch}{lifted}"


def _until(last: Decision) -> str:
    if _is_lifted(last):
        return f"{local_time(last.event_time)}, it is lifted"
    return local_time(last.expires) if last.expires else "without end"


def _undo(first: Decision, last: Decision) -> str:
    if _is_lifted(last):
        return "nothing to undo"
    if first.action == "protect" and not first.expires:
        return "take the service out of `guard` in the firewall's settings"
    never = f"; never again: sdnator allow add {first.target.address}" if first.action == "block" else ""
    wrong = f"; false alarm: sdnator blocks false-alarm {first.id}" if first.grounds else ""
    return f"sdnator blocks remove {first.id}{wrong}{never}"


def _short(text: str) -> str:
    head = one_line(text.partition(";")[0])
    return head if len(head) <= _WORDS else f"{head[:_WORDS]}…"


def _is_lifted(decision: Decision) -> bool:
    return decision.action.startswith("un")
