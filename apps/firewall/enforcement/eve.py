"""Incidents, decisions, notices and drops as EVE JSON, the log format that SIEMs read.

The only writer of it: the firewall's sinks and the report of a replay say the same thing the same way.

    incident    `alert`: one line when it opens, when something is decided or confirmed, and when it is over
    decision    `alert`: only what belongs to no incident, as blocks by hand
    notice      `alert`: what operators should know, such as a cap that was reached
    drops       `drop`: packets of a sender that the switch dropped within a second (replay)

`signature_id` and `signature` depend on the kind alone, so that rules of a SIEM keep working; words and figures are
in `alert.metadata`, whose values are lists of texts.  All fields are Suricata's own: its schema allows no others.

Source: Suricata's EVE format and its `etc/schema.json`.
"""

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from ipaddress import ip_address
from typing import Any, Final, Literal

from apps.evidence import Kind
from apps.firewall.enforcement.ecs import as_ecs
from apps.firewall.policy.block_lifecycle import OperatorNotice
from apps.incidents import REMEDY_WORDS, Incident, IncidentAction
from apps.messages import Decision, RateLimit, Sender

EveFormat = Literal["eve", "ecs"]
Event = dict[str, Any]

_SECOND: Final = 1_000_000_000
_GID: Final = 1
_REV: Final = 1
_ALIKE: Final = 5
"""Texts of evidence in a line."""

SIGNATURES: Final[dict[Kind, tuple[int, str, str, int]]] = {
    "scan": (9_100_101, "SDNATOR scan", "Detection of a Network Scan", 3),
    "flood": (9_100_102, "SDNATOR flood", "Detection of a Denial of Service Attack", 2),
    "guessing": (9_100_103, "SDNATOR password guessing", "Attempted User Privilege Gain", 1),
    "spoofing": (9_100_104, "SDNATOR spoofed address", "Potentially Bad Traffic", 2),
    "unlike_training": (9_100_105, "SDNATOR traffic unlike training", "Potentially Bad Traffic", 2),
    "offence": (9_100_106, "SDNATOR earlier offence", "Potentially Bad Traffic", 2),
    "other": (9_100_107, "SDNATOR incident", "Misc Attack", 2),
}
"""By kind of incident: signature id, signature, and Suricata's classification with its priority."""
DECISION_SIGNATURES: Final = {
    "block": (9_100_201, "SDNATOR block", 1),
    "protect": (9_100_202, "SDNATOR guard", 1),
    "meter": (9_100_205, "SDNATOR rate limit", 1),
    "unblock": (9_100_203, "SDNATOR block lifted", 3),
    "unprotect": (9_100_204, "SDNATOR guard lifted", 3),
    "unmeter": (9_100_206, "SDNATOR rate limit lifted", 3),
}
_OTHER_DECISION: Final = (9_100_200, "SDNATOR decision", 2)
NOTICE_SIGNATURE: Final = (9_100_301, "SDNATOR notice")
_STOPPING: Final = ("block", "guard")
"""Remedies that keep packets from their victims; a rate limit lets some of them pass."""


def incident_event(incident: Incident) -> Event:
    """An incident as it is now.

    Args:
        incident: as published.

    Returns:
        An `alert`; its action is `blocked` only where an enforcer has confirmed a block or guard.
    """
    number, signature, category, severity = SIGNATURES[incident.kind]
    stopped = any(action.enforced and action.remedy in _STOPPING for action in incident.actions)
    event = _event("alert", incident.event_time)
    event["flow_id"] = flow_id(incident.id)
    event |= _from(incident.attacker)
    if incident.victims:
        event["dest_ip"] = incident.victims[0]
    event |= _service(incident.service)
    cost = incident.cost
    said: dict[str, list[str]] = {
        "incident": [incident.id],
        "event": [incident.change],
        "state": [incident.state],
        "attacker": [incident.attacker_text],
        "attackers": [str(incident.attacker_count)],
        "victims": list(incident.victims),
        "victim_count": [str(incident.victim_count)],
        "service": [incident.service],
        "begun": [time_text(incident.begun)],
        "last": [time_text(incident.last)],
        "packets": [str(incident.packets)],
        "first_packet": [str(incident.first_packet)],
        "nats": [f"{incident.nats:.4g}"],
        "bound": [f"{incident.bound:.4g}"],
        "evidence": [f"{piece.source}: {piece.text}" for piece in incident.evidence[-_ALIKE:]],
        "remedy": [remedy_words(action) for action in incident.actions],
        "decision": [action.decision for action in incident.actions if action.decision],
        "enforcers": sorted({place for action in incident.actions for place in action.places}),
        "dropped": [str(cost.dropped)],
        "challenged": [str(cost.challenged)],
        "metered": [str(cost.metered)],
        "part_of": [incident.joined],
    }
    event["alert"] = _alert(number, signature, category, severity, "blocked" if stopped else "allowed", said)
    return event


def decision_event(decision: Decision, places: Sequence[str] = ()) -> Event:
    """A decision that belongs to no incident: an alert, whose action is `blocked` once an enforcer has confirmed a block.

    Args:
        decision: the decision.
        places: enforcers that have confirmed it; none: it was decided just now.
    """
    number, signature, severity = DECISION_SIGNATURES.get(decision.action, _OTHER_DECISION)
    target = decision.target
    event = _event("alert", decision.event_time)
    event["flow_id"] = flow_id(decision.id)
    if decision.action in ("protect", "unprotect"):
        event |= {"dest_ip": target.address, "dest_port": target.port, "proto": "TCP"}
    elif decision.limit is not None:
        event |= {"dest_ip": target.address} | _limited(decision.limit)
    elif target.kind == "mac":
        event["ether"] = {"src_mac": target.address}
        if target.port is not None:
            event["in_iface"] = f"{decision.switch}:{target.port}"
    elif "/" not in target.address:  # programs that expect an address there take no prefix
        event["src_ip"] = target.address
    blocks = decision.action == "block" and not decision.dry_run and bool(places)
    said = {
        "decision": [decision.id],
        "target": [target.address],
        "switch": [decision.switch],
        "reason": [decision.reason],
        "until": [time_text(decision.expires)] if decision.expires else [],
        "dry_run": ["yes"] if decision.dry_run else [],
        "event": ["confirmed"] if places else [],
        "enforcers": list(places),
    }
    action = "blocked" if blocks else "allowed"
    event["alert"] = _alert(number, signature, decision.action, severity, action, said)
    return event


def notice_event(notice: OperatorNotice) -> Event:
    """A notice to operators, such as a cap that was reached."""
    number, signature = NOTICE_SIGNATURE
    event = _event("alert", notice.event_time)
    said = {"text": [notice.text]}
    event["alert"] = _alert(number, signature, notice.kind, 1, "allowed", said)
    return event


def drop_event(time_ns: int, ip: str, mac: str, packets: int, first_packet: int) -> Event:
    """Packets of a sender that were dropped within a second.

    Args:
        time_ns: capture time of the first of them.
        ip: the sender's address; empty if there is none.
        mac: the sender's MAC.
        packets: how many.
        first_packet: arrival number of the first.
    """
    event = _event("drop", time_ns)
    if ip:
        event["src_ip"] = ip
    # Suricata counts packets of a capture from 1
    return event | {
        "ether": {"src_mac": mac},
        "pcap_cnt": first_packet + 1,
        "drop": {"reason": "rules"},
        "flow": {"pkts_toserver": packets, "action": "drop"},
    }


def line_of(event: Event, form: EveFormat = "eve") -> str:
    """An event as one line, in EVE's fields or in those of the Elastic Common Schema."""
    return json.dumps(event if form == "eve" else as_ecs(event))


def remedy_words(action: IncidentAction) -> str:
    """What was done, in words: `block`, `would block`, `guard (failed)`."""
    words = REMEDY_WORDS.get(action.remedy, action.remedy)
    words = f"would {words}" if action.dry_run and action.remedy != "alert" else words
    return f"{words} (failed)" if action.state == "failed" else words


def time_text(time_ns: int) -> str:
    """A time as EVE writes it: ISO 8601 in UTC with microseconds."""
    at = datetime.fromtimestamp(time_ns // _SECOND, UTC).replace(microsecond=time_ns % _SECOND // 1000)
    return at.strftime("%Y-%m-%dT%H:%M:%S.%f%z")


def flow_id(name: str) -> int:
    """The same number for every line about one thing: 48 bits, which every JSON reader can hold."""
    try:
        return int(name, 16) & (1 << 48) - 1
    except ValueError:
        return int.from_bytes(name.encode()[:6], "big")


def _event(kind: str, time_ns: int) -> Event:
    return {"timestamp": time_text(time_ns), "event_type": kind}


def _from(sender: Sender | None) -> Event:
    if sender is None:
        return {}
    named: Event = {"in_iface": f"{sender.switch}:{sender.port}", "ether": {"src_mac": sender.mac}}
    if sender.ip:
        named |= {"src_ip": sender.ip, "ip_v": ip_address(sender.ip).version}
    return named


def _service(service: str) -> Event:
    """`tcp/22` as Suricata's fields; the source port of reflectors is all that an incident has of one."""
    name, _, port = service.partition("/")
    if not name:
        return {}
    # floods: datagrams from a port, segments of no connection to one
    proto = {"from-udp": "udp", "tcp-ack": "tcp"}.get(name, name)
    found: Event = {"proto": proto.upper()}
    if port.isdecimal() and int(port) <= 65_535:
        found["src_port" if name == "from-udp" else "dest_port"] = int(port)
    return found


def _limited(limit: RateLimit) -> Event:
    """The packets of a rate limit as Suricata's fields."""
    proto = {"udp_from": "udp", "udp_to": "udp", "syn": "tcp"}.get(limit.kind, limit.kind).upper()
    port = "src_port" if limit.kind == "udp_from" else "dest_port"
    return {"proto": proto} | ({} if limit.port is None else {port: limit.port})


def _alert(
    number: int, signature: str, category: str, severity: int, action: str, said: dict[str, list[str]]
) -> Event:
    return {
        "action": action,
        "gid": _GID,
        "signature_id": number,
        "rev": _REV,
        "signature": signature,
        "category": category,
        "severity": severity,
        "metadata": {name: texts for name, texts in said.items() if any(texts)},
    }
