"""EVE events in the field names of the Elastic Common Schema, for stores that expect those.  Pure.

What the schema has no field for stands under `sdnator`, as it allows.

Source: Elastic Common Schema 8.11, field sets event, rule, source, destination, network, observer, related.
"""

from typing import Any, Final

VERSION: Final = "8.11.0"
_TRANSPORTS: Final = ("tcp", "udp", "icmp", "sctp")


def as_ecs(event: dict[str, Any]) -> dict[str, Any]:
    """Translate an EVE event of this product.

    Args:
        event: as `eve.py` makes it.

    Returns:
        The same facts as a document of the Elastic Common Schema.
    """
    said: dict[str, list[str]] = event.get("alert", {}).get("metadata", {})
    document: dict[str, Any] = {
        "@timestamp": event["timestamp"],
        "ecs": {"version": VERSION},
        "observer": {"vendor": "SDNator", "product": "SDNator", "type": "ips"},
        "event": _event(event, said),
    }
    if "in_iface" in event:
        document["observer"]["ingress"] = {"interface": {"name": event["in_iface"]}}
    if "alert" in event:
        alert = event["alert"]
        document["rule"] = {
            "id": str(alert["signature_id"]),
            "name": alert["signature"],
            "category": alert["category"],
            "version": str(alert["rev"]),
        }
        document["message"] = alert["signature"]
        if said:
            document["sdnator"] = said
    document |= _ends(event)
    return document


def _event(event: dict[str, Any], said: dict[str, list[str]]) -> dict[str, Any]:
    dropped = event["event_type"] == "drop"
    denied = dropped or event.get("alert", {}).get("action") == "blocked"
    found: dict[str, Any] = {
        "kind": "event" if dropped else "alert",
        "category": ["network"] if dropped else ["network", "intrusion_detection"],
        "type": ["denied" if denied else "info"],
        "module": "sdnator",
        "dataset": "sdnator.drop" if dropped else "sdnator.alert",
    }
    if "alert" in event:
        found["severity"] = event["alert"]["severity"]
    for name, field in (("incident", "id"), ("decision", "id"), ("event", "action"), ("reason", "reason")):
        if name in said:
            found.setdefault(field, said[name][0])
    for name, field in (("begun", "start"), ("last", "end")):
        if name in said:
            found[field] = said[name][0]
    return found


def _ends(event: dict[str, Any]) -> dict[str, Any]:
    """Source, destination and network."""
    proto = event.get("proto", "").lower()
    version = event.get("ip_v")
    mac = event.get("ether", {}).get("src_mac", "")
    parts = {
        # RFC 7042's spelling of a MAC: capitals and hyphens
        "source": {
            "ip": event.get("src_ip"),
            "mac": mac.upper().replace(":", "-") or None,
            "packets": event.get("flow", {}).get("pkts_toserver"),
        },
        "destination": {"ip": event.get("dest_ip"), "port": event.get("dest_port")},
        "network": {
            "transport" if proto in _TRANSPORTS else "protocol": proto or None,
            "type": f"ipv{version}" if version else None,
        },
        "related": {"ip": [event[name] for name in ("src_ip", "dest_ip") if name in event] or None},
    }
    known = {
        name: {field: value for field, value in part.items() if value is not None}
        for name, part in parts.items()
    }
    return {name: part for name, part in known.items() if part}
