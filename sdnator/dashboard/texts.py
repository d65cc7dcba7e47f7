"""How times, rates and things are written on the pages.  Pure."""

from datetime import datetime
from typing import Any

from msgspec import structs

from apps.incidents import Incident
from apps.messages import Alert, Decision
from sdnator.incidents.incident_rows import row

_STANDING = ("installed", "exists")


def clock(time_ns: int) -> str:
    """A time of day in the server's time zone, which it names, with the date where that is not today's."""
    when = datetime.fromtimestamp(time_ns // 10**9).astimezone()
    today = datetime.now().astimezone().date() == when.date()
    return f"{when:%H:%M:%S %Z}" if today else f"{when:%Y-%m-%d %H:%M:%S %Z}"


def number(value: float) -> str:
    """Short: 12, 4.1 k, 2.3 M."""
    for least, unit in ((1e6, " M"), (1e4, " k")):
        if value >= least:
            return f"{value / least:.1f}{unit}" if unit == " M" else f"{value / 1e3:.1f}{unit}"
    return f"{value:,.0f}" if value >= 10 or value == int(value) else f"{value:.1f}"


def decision_row(one: Decision, answers: dict[str, str]) -> dict[str, Any]:
    """A decision for the list."""
    until = f"until {clock(one.expires)}" if one.expires else "without end"
    said = _places_said(answers)
    where = "all switches" if one.switch in ("", "*") else one.switch
    # without any answer nobody knows: the page may be younger than the block
    nowhere = bool(answers) and not any(text.startswith(_STANDING) for text in answers.values())
    doing = structs.replace(one, dry_run=one.dry_run or nowhere).doing
    return {
        "id": one.id,
        "action": doing,
        "word": doing.replace("protect", "guard"),
        "target": one.what,
        "address": one.target.address,
        "where": f"{where} · {until}",
        "reason": one.reason,
        "said": said,
        # a guard without end is one that the settings name: it stays
        "undo": "Undo" if one.action == "block" else "Release" if one.expires else "",
        "allow": one.action == "block",
        # only what evidence added up to can be unlearnt
        "false_alarm": bool(one.grounds),
    }


def _places_said(answers: dict[str, str]) -> str:
    """Where a decision is in force; who keeps it for later, has refused it and why, or has ended it."""
    stands = sorted(place for place, text in answers.items() if text.startswith(_STANDING))
    found = [f"in force: {', '.join(stands)}"] if stands else []
    for place, text in sorted(answers.items()):
        state, _, cause = text.partition(": ")
        if state == "failed":
            found.append(f"{place} refused it: {cause}" if cause else f"{place} refused it")
        elif state == "pending":
            found.append(f"{place} has it pending: {cause}")
        elif place not in stands:
            found.append(f"{place}: {state}")
    return "; ".join(found)


def alert_row(one: Alert, number: int) -> dict[str, Any]:
    """An alert for the list."""
    sender = one.sender
    who = f"{sender.ip or sender.mac}" + (f" ({sender.mac})" if sender.ip else "")
    return {
        "id": number,
        "target": who,
        "address": sender.ip or sender.mac,
        "where": f"{clock(one.event_time)} · {sender.switch} port {sender.port} · score {one.peak_score:.1f} "
        f"· {one.over} of {one.packets} packets at or above the threshold",
        "reason": one.reason,
    }


def incident_row(one: Incident) -> dict[str, Any]:
    """An incident for the list."""
    texts = row(one)
    over = "" if one.state == "open" else " · over"
    return {
        "id": one.id,
        "action": "incident",
        "word": "",
        "target": f"{texts['kind']}: {texts['attacker']}",
        "address": "",
        "where": f"{clock(one.begun)} · against {texts['victims']}{over}",
        "reason": "no action" if texts["done"] == "nothing" else texts["done"],
        "said": f"{texts['stopped']} packets stopped" if one.cost.stopped else "",
    }
