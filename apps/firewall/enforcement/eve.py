"""Alerts and decisions as EVE JSON, the log format that SIEMs read.  Source: Suricata's EVE format."""

import json
from datetime import UTC, datetime
from typing import Any

from apps.firewall.policy.block_lifecycle import OperatorNotice
from apps.messages import Alert, Decision

_SECOND = 1_000_000_000


def alert_line(alert: Alert) -> str:
    """One line for an alert."""
    event = _event("alert", alert.event_time) | {
        "src_ip": alert.sender.ip,
        "in_iface": f"port{alert.sender.port}",
    }
    event["ether"] = {"src_mac": alert.sender.mac}
    event["alert"] = {
        "action": "allowed",
        "signature": alert.reason,
        "category": "anomaly",
        "severity": 3,
        "metadata": {"id": [alert.id], "peak_score": [f"{alert.peak_score:.3g}"]},
    }
    return json.dumps(event)


def decision_line(decision: Decision) -> str:
    """One line for a decision: a block is an alert with the action `blocked`."""
    target = decision.target
    event = _event("alert", decision.event_time)
    if decision.action in ("protect", "unprotect"):
        event |= {"dest_ip": target.address, "dest_port": target.port, "proto": "TCP"}
    elif target.kind == "ip":
        event["src_ip"] = target.address
    else:
        event["ether"] = {"src_mac": target.address}
    blocks = decision.action == "block" and not decision.dry_run
    event["alert"] = {
        "action": "blocked" if blocks else "allowed",
        "signature": decision.reason,
        "category": decision.action,
        "severity": 1 if decision.action in ("block", "protect") else 3,
        "metadata": {"id": [decision.id], "switch": [decision.switch]},
    }
    return json.dumps(event)


def notice_line(notice: OperatorNotice) -> str:
    """One line for a notice to operators, such as a cap that was reached."""
    event = _event("alert", notice.event_time)
    event["alert"] = {
        "action": "allowed",
        "signature": notice.text,
        "category": notice.kind,
        "severity": 1,
    }
    return json.dumps(event)


def _event(kind: str, time_ns: int) -> dict[str, Any]:
    at = datetime.fromtimestamp(time_ns // _SECOND, UTC).replace(microsecond=time_ns % _SECOND // 1000)
    return {"timestamp": at.strftime("%Y-%m-%dT%H:%M:%S.%f%z"), "event_type": kind}
