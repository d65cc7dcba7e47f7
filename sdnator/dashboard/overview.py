"""What the first page says of the pipeline: one sentence, what was done about an incident, what is asked.  Pure."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

from apps.enforcement import place_text
from apps.incidents import REMEDY_WORDS, Incident
from apps.messages import one_line
from sdnator.dashboard.board import Board
from sdnator.dashboard.texts import clock, number
from sdnator.model_words import headline
from sdnator.plurals import counted

Level = Literal["well", "notice", "trouble"]
_LOST: Final = ("lost", "dropped_slow", "set_aside", "set_aside_lost")
_ACTION_STATES: Final = {"decided": "decided", "in_force": "in force", "over": "over", "failed": "FAILED"}
_TALKED_S: Final = 10.0
"""A list that is older says nothing of now: the switch is silent, or nobody counts."""
_TALKERS: Final = 10
_CAUSE: Final = 120
_COSTS: Final = {
    "packet_in": "packet-in",
    "digests": "digest",
    "counts_reported": "reported count",
    "cells_answered": "read cell",
}


@dataclass(frozen=True)
class Health:
    """The sentence of health and how grave it is."""

    level: Level
    text: str


def health(board: Board) -> Health:
    """One sentence; the caller holds the board's lock."""
    if trouble := "; ".join(filter(None, (board.degraded, board.coordinator))):
        return Health("trouble", f"Not all is well: {trouble}.")
    switches = board.switches.values()
    away = [name for name, one in board.switches.items() if not (one.get("connected") and one.get("primary"))]
    if not board.switches:
        return Health("notice", "Waiting for a switch: none has reported yet.")
    if away:
        verb = "is" if len(away) == 1 else "are"
        return Health("trouble", f"Switch {', '.join(away)} {verb} not under control.")
    if idle := _idle_enforcers(board):
        return Health("trouble", f"Blocks are not carried out everywhere: {idle}.")
    missing = [app["app_id"] for app in board.present() if "active" not in app["states"]]
    if missing:
        return Health("trouble", f"No instance of {', '.join(missing)} is active.")
    parts = [_guarding(switches), _incidents(board), _lost(board), *_undelivered(board)]
    model = board.model()
    if model is not None and not model.get("done"):
        parts.insert(1, f"{headline(model)}, and nobody is blocked before")
    untrained = model is not None and not model.get("done")
    grave = board.open_incidents() or lost(board) or list(_undelivered(board)) or untrained
    text = "; ".join(parts)
    return Health("notice" if grave else "well", f"{text[:1].upper()}{text[1:]}.")


def lost(board: Board) -> int:
    """Packet-ins, items and frames that never arrived where they were to go."""
    packets = sum(int(one.get("lost", 0)) for one in board.switches.values())
    for one in board.health.values():
        engine = one.get("engine", {})
        for counters in (engine.get("receiving", {}), engine.get("archive", {})):
            packets += sum(int(counters.get(name) or 0) for name in _LOST)
    return packets


def _guarding(switches: Any) -> str:
    copies = sum(bool(one.get("mirror")) for one in switches)
    text = f"guarding {counted(len(switches), 'switch')}" if copies < len(switches) else ""
    watching = f"watching copies of {counted(copies, 'switch')}" if copies else ""
    return " and ".join(filter(None, (text, watching)))


def _incidents(board: Board) -> str:
    count = board.open_incidents()
    return f"{counted(count, 'open incident')}" if count else "no open incident"


def _lost(board: Board) -> str:
    count = lost(board)
    return f"{count:,} lost, see Machinery" if count else "nothing lost"


def _idle_enforcers(board: Board) -> str:
    """Enforcers besides the switches that say of themselves that they do not work, and why."""
    said = ((app, one.get("app", {})) for app, one in board.health.items())
    return "; ".join(
        f"{place_text(app, str(one['place']))}: {one_line(str(one.get('problem', '')))[:_CAUSE]}"
        for app, one in said
        if "place" in one and one.get("enforcing") and one.get("working") is False
    )


def _undelivered(board: Board) -> Iterator[str]:
    """Events that no collector will get, by the way on which they were lost."""
    for one in board.health.get("firewall", {}).get("app", {}).get("sinks", ()):
        if count := int(one.get("lost") or 0):
            yield f"{counted(count, 'event')} not delivered by {one.get('name')}"


def timeline(incident: Incident) -> list[str]:
    """What happened, in order of time: its first packet, decisions, when they were in force, the end."""
    found = [(incident.begun, "first packet")]
    for action in incident.actions:
        words = f"{REMEDY_WORDS.get(action.remedy, action.remedy)} {action.target}".strip()
        found.append((action.since, f"{'would ' if action.dry_run else ''}{words}: {action.reason}"))
        if action.effective:
            where = ", ".join(action.places) or action.switch
            found.append((action.effective, f"{words} in force{f' on {where}' if where else ''}"))
        if action.state in ("over", "failed"):
            ended = min(action.until or incident.last, incident.event_time)
            found.append((ended, f"{words} {_ACTION_STATES[action.state]}"))
    if incident.state == "over":
        found.append((incident.event_time, "over"))
    return [f"{clock(time)}  {text}" for time, text in sorted(found, key=lambda one: one[0])]


def asked_rows(board: Board) -> Iterator[dict[str, Any]]:
    """By switch: which telemetry is in force, and what that sends to the controller a second."""
    for name, one in board.switches.items():
        cost = board.cost.get(name, {})
        sent = [f"{number(cost[key])} {words}s/s" for key, words in _COSTS.items() if cost.get(key)]
        asked = [str(each) for each in one.get("telemetry", ())]
        yield {
            "id": name,
            "target": f"{name}: {counted(len(asked), 'request')} in force",
            "where": ", ".join(sent) or "nothing is sent at the moment",
            "reason": ", ".join(asked) or "nothing is requested from it: it copies no packets",
            "action": "",
        }


def talker_rows(board: Board, now: float) -> list[dict[str, Any]]:
    """The senders of most bytes through all switches, the busiest first; none where nothing has come for a while."""
    found = []
    for heard, one in board.talkers.values():
        seconds = (one.event_time - one.since) / 1e9
        if now - heard > _TALKED_S or seconds <= 0:
            continue
        for each in one.talkers:
            who = each.sender.ip or each.sender.mac
            row = {
                "id": f"{one.switch} {each.sender.port} {who}",
                "sender": who,
                "from": f"{one.switch} port {each.sender.port}",
                "bits": number(8 * each.bytes / seconds),
                "packets": number(each.packets / seconds),
                "share": f"{each.bytes / max(1, one.bytes):.0%}",
            }
            found.append((8 * each.bytes / seconds, row))
    return [row for _, row in sorted(found, key=lambda one: -one[0])[:_TALKERS]]


def port_rows(
    name: str, before: Mapping[str, Any] | None, now: Mapping[str, Any], seconds: float
) -> Iterator[dict[str, Any]]:
    """Rates by port from two readings of a switch's counters, `seconds` apart; without a first one, none."""
    for port, (packets, octets, dropped) in sorted(now.items()):
        was = (before or {}).get(port)
        rates = ["-", "-", "-"]
        if was is not None and seconds > 0:
            grown = (packets - was[0], 8 * (octets - was[1]), dropped - was[2])
            rates = [number(max(0, one) / seconds) for one in grown]
        yield {
            "id": f"{name} {port}",
            "port": f"{name} {port}",
            "forwarded": rates[0],
            "bits": rates[1],
            "dropped": rates[2],
            "total": f"{dropped:,}",
        }
