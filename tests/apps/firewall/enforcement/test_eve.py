"""EVE JSON: one line an event, with the fields that SIEMs look for."""

import json
from typing import Any

from apps.firewall.enforcement.eve import alert_line, decision_line
from apps.messages import Decision, Target
from tests.apps.firewall.alerts import alert


def decision(**changes) -> Decision:
    fields: dict[str, Any] = {
        "id": "d1",
        "action": "block",
        "switch": "s1",
        "target": Target(kind="ip", address="192.0.2.1"),
        "reason": "why",
        "event_time": 1_700_000_000_123_456_789,
        "expires": 0,
    }
    return Decision(**(fields | changes))


def test_alert():
    """Address, MAC and reason of the sender."""
    line = alert_line(alert())
    assert "\n" not in line
    event = json.loads(line)
    assert (event["event_type"], event["src_ip"]) == ("alert", "192.168.2.108")
    assert event["timestamp"] == "1970-01-01T00:01:40.000000+0000"
    assert event["alert"]["signature"].startswith("192.168.2.108 sends")


def test_decisions():
    """A block is 'blocked' unless it is a dry run; a guard names the service."""
    blocked = json.loads(decision_line(decision()))
    assert (blocked["src_ip"], blocked["alert"]["action"]) == ("192.0.2.1", "blocked")
    assert blocked["timestamp"] == "2023-11-14T22:13:20.123456+0000"
    assert json.loads(decision_line(decision(dry_run=True)))["alert"]["action"] == "allowed"
    mac = decision(target=Target(kind="mac", address="02:00:00:00:00:01", port=1))
    assert json.loads(decision_line(mac))["ether"] == {"src_mac": "02:00:00:00:00:01"}
    guard = decision(action="protect", target=Target(kind="ip", address="2001:db8::1", port=443))
    event = json.loads(decision_line(guard))
    assert (event["dest_ip"], event["dest_port"], event["alert"]["category"]) == (
        "2001:db8::1",
        443,
        "protect",
    )
