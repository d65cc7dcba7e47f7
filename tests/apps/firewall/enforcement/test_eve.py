"""EVE JSON: one line an event, with the fields that SIEMs look for and no others."""

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.firewall.enforcement.eve import (
    SIGNATURES,
    decision_event,
    drop_event,
    flow_id,
    incident_event,
    line_of,
    notice_event,
)
from apps.firewall.incidents.incident_book import IncidentBook
from apps.firewall.policy.block_lifecycle import OperatorNotice
from apps.incidents import Incident
from apps.messages import Decision, RateLimit, Target
from tests.apps.firewall.incidents import samples

KINDS = {str: "string", int: "integer", dict: "object", list: "array", bool: "boolean"}
FIELDS = {
    "": {
        "timestamp": "string", "event_type": "string", "flow_id": "integer", "in_iface": "string", "src_ip": "string",
        "dest_ip": "string", "dest_port": "integer", "proto": "string", "ip_v": "integer", "pcap_cnt": "integer",
        "ether": "object", "alert": "object", "drop": "object", "flow": "object",
    },
    "alert": {
        "action": "string", "gid": "integer", "signature_id": "integer", "rev": "integer", "signature": "string",
        "category": "string", "severity": "integer", "metadata": "object",
    },
    "ether": {"src_mac": "string"},
    "drop": {"reason": "string"},
    "flow": {"pkts_toserver": "integer", "action": "string"},
}  # fmt: skip
"""What Suricata's schema (etc/schema.json, August 2026) says of the fields that we use; it allows no unknown ones."""
SCHEMA = os.environ.get("SURICATA_SCHEMA", "")
"""Path to Suricata's etc/schema.json, for a check against all of it."""


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


@pytest.mark.parametrize(
    ("limit", "said"),
    [
        ({"kind": "udp_from", "port": 53}, {"proto": "UDP", "src_port": 53}),
        ({"kind": "tcp", "port": 443}, {"proto": "TCP", "dest_port": 443}),
        ({"kind": "syn", "open_ports": (443,)}, {"proto": "TCP"}),
        ({"kind": "icmp"}, {"proto": "ICMP"}),
    ],
)
def test_the_packets_of_a_rate_limit_have_protocol_and_port(limit, said):
    event = decision_event(decision(action="meter", limit=RateLimit(rate=5, **limit)))
    assert {name: event[name] for name in ("proto", "src_port", "dest_port") if name in event} == said


def life() -> list[Incident]:
    """An incident that was opened, decided and confirmed."""
    book = IncidentBook()
    told = book.hear_evidence(samples.evidence(), 8.0, samples.BOUND)
    return told + book.decided(samples.decision()) + book.confirmed(samples.confirmation())


def events() -> dict[str, dict[str, Any]]:
    """One of each."""
    opened, decided, confirmed = (incident_event(each) for each in life())
    guard = decision(action="protect", target=Target(kind="ip", address="2001:db8::1", port=443))
    (forged,) = IncidentBook().hear_evidence(
        samples.evidence(sender=None, kind="flood", service="arp"), 20.0, 10.0
    )
    return {
        "opened": opened,
        "decided": decided,
        "confirmed": confirmed,
        "forged": incident_event(forged),
        "block by hand": decision_event(decision(expires=10**18)),
        "MAC by hand": decision_event(
            decision(target=Target(kind="mac", address="02:00:00:00:00:01", port=1))
        ),
        "prefix by hand": decision_event(decision(target=Target(kind="ip", address="192.0.2.0/24"))),
        "guard": decision_event(guard),
        "dry run": decision_event(decision(dry_run=True)),
        "notice": notice_event(OperatorNotice("cap", "BLOCKING STOPPED", 5)),
        "drop": drop_event(5, "192.0.2.1", "02:00:00:00:00:01", 9, 99),
    }


EVENTS = events()


@pytest.mark.parametrize("name", EVENTS)
def test_every_line_has_suricatas_fields_only(name):
    """Types and names are those of its schema, required ones are there, texts of metadata stand in lists."""
    line = line_of(EVENTS[name])
    assert "\n" not in line
    event = json.loads(line)
    assert {"timestamp", "event_type"} <= event.keys()
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d+[+-]\d+", event["timestamp"])
    for place, fields in FIELDS.items():
        part = event.get(place, {}) if place else event
        found = {field: KINDS[type(value)] for field, value in part.items()}
        assert found == {field: fields.get(field) for field in found}
    for texts in event.get("alert", {}).get("metadata", {}).values():
        assert texts
        assert all(isinstance(text, str) for text in texts)


def test_an_incident_is_blocked_when_a_switch_says_so():
    """Who, whom, which service; `blocked` only after the confirmation; the same flow and signature throughout."""
    opened, decided, confirmed = EVENTS["opened"], EVENTS["decided"], EVENTS["confirmed"]
    assert (opened["src_ip"], opened["dest_ip"], opened["dest_port"]) == ("192.168.2.108", samples.SERVER, 22)
    assert (opened["proto"], opened["in_iface"]) == ("TCP", "s1:1")
    actions = [each["alert"]["action"] for each in (opened, decided, confirmed)]
    assert actions == ["allowed", "allowed", "blocked"]
    assert (
        len({(each["flow_id"], each["alert"]["signature_id"]) for each in (opened, decided, confirmed)}) == 1
    )
    assert confirmed["alert"]["signature"] == "SDNATOR scan"
    assert confirmed["alert"]["metadata"]["evidence"] == [
        "strangers: SYNs to 20 hosts that it never spoke to"
    ]


def test_what_only_would_be_blocked_is_allowed():
    """A dry run claims nothing, even where a switch has answered."""
    book = IncidentBook()
    book.hear_evidence(samples.evidence(), 8.0, samples.BOUND)
    book.decided(samples.decision(dry_run=True))
    event = incident_event(book.confirmed(samples.confirmation())[0])
    assert event["alert"]["action"] == EVENTS["dry run"]["alert"]["action"] == "allowed"
    assert event["alert"]["metadata"]["remedy"] == ["would block"]


def test_decisions_by_hand():
    """A block names its source, a guard the service; a prefix is no address; nothing is blocked before it is confirmed."""
    assert EVENTS["block by hand"]["src_ip"] == "192.0.2.1"
    places = ["nftables gateway"]
    in_force = decision_event(decision(), places)["alert"]
    assert [EVENTS["block by hand"]["alert"]["action"], in_force["action"]] == ["allowed", "blocked"]
    assert in_force["metadata"]["enforcers"] == places
    assert decision_event(decision(dry_run=True), places)["alert"]["action"] == "allowed"
    assert EVENTS["block by hand"]["timestamp"] == "2023-11-14T22:13:20.123456+0000"
    assert EVENTS["MAC by hand"]["ether"] == {"src_mac": "02:00:00:00:00:01"}
    assert (EVENTS["guard"]["dest_ip"], EVENTS["guard"]["dest_port"]) == ("2001:db8::1", 443)
    assert "src_ip" not in EVENTS["prefix by hand"]
    assert EVENTS["prefix by hand"]["alert"]["metadata"]["target"] == ["192.0.2.0/24"]


def test_signatures_are_distinct():
    numbers = [number for number, *_ in SIGNATURES.values()]
    assert len(set(numbers)) == len(numbers)


@given(st.text(max_size=300))
def test_flow_ids_fit_every_reader(name):
    assert 0 <= flow_id(name) < 1 << 53


def test_the_elastic_common_schema_has_the_same_facts():
    """Names and values that Elastic's schema prescribes."""
    found = json.loads(line_of(EVENTS["confirmed"], "ecs"))
    assert found["event"]["kind"] == "alert"
    assert found["event"]["type"] == ["denied"]
    assert found["rule"] == {
        "id": "9100101",
        "name": "SDNATOR scan",
        "category": "Detection of a Network Scan",
        "version": "1",
    }
    assert found["source"] == {"ip": "192.168.2.108", "mac": "5C-CF-7F-05-F2-C6"}
    assert found["destination"] == {"ip": samples.SERVER, "port": 22}
    assert found["network"] == {"transport": "tcp", "type": "ipv4"}
    assert found["related"]["ip"] == ["192.168.2.108", samples.SERVER]
    assert found["event"]["start"] < found["event"]["end"] < found["@timestamp"]
    drop = json.loads(line_of(EVENTS["drop"], "ecs"))
    assert (drop["event"]["kind"], drop["source"]["packets"]) == ("event", 9)


@pytest.mark.skipif(not SCHEMA, reason="give the path of Suricata's etc/schema.json in SURICATA_SCHEMA")
@pytest.mark.parametrize("name", EVENTS)
def test_every_line_fits_suricatas_own_schema(name):
    """All of it, by the file that Suricata checks its own output with."""
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.validate(EVENTS[name], json.loads(Path(SCHEMA).read_bytes()))
