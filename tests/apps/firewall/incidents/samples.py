"""Evidence and decisions for tests of incidents."""

from typing import Any

from apps.evidence import Evidence
from apps.messages import Confirmation, Decision, Exhibit, Sender, Target
from tests.apps.firewall.alerts import CAMERA, SECOND

PHONE = Sender(switch="s1", port=2, mac="02:00:00:00:00:02", ip="192.168.2.2")
SERVER = "192.168.2.50"
BOUND = 10.0


def evidence(at_s: float = 100.0, sender: Sender | None = CAMERA, **changes: Any) -> Evidence:
    """A piece of evidence of a scan."""
    fields: dict[str, Any] = {
        "id": f"e{at_s}",
        "kind": "scan",
        "source": "strangers",
        "sender": sender,
        "victims": (SERVER,),
        "victim_count": 1,
        "service": "tcp/22",
        "nats": 6.0,
        "since": round((at_s - 0.5) * SECOND),
        "event_time": round(at_s * SECOND),
        "packets": 20,
        "first_packet": 500,
        "mac_addresses": 1,
        "text": "SYNs to 20 hosts that it never spoke to",
    }
    return Evidence(**(fields | changes))


def decision(at_s: float = 101.0, **changes: Any) -> Decision:
    """A block of the camera's MAC for ten minutes."""
    fields: dict[str, Any] = {
        "id": "d1",
        "action": "block",
        "switch": "s1",
        "target": Target(kind="mac", address=CAMERA.mac, port=1),
        "reason": "the sum has reached its bound",
        "evidence": (Exhibit(key="network.evidence.kitsune.scan", timestamp=1, summary="strangers"),),
        "event_time": round(at_s * SECOND),
        "expires": round((at_s + 600) * SECOND),
        "first_packet": 520,
    }
    return Decision(**(fields | changes))


def confirmation(at_s: float = 101.1, name: str = "d1", state: Any = "installed") -> Confirmation:
    """The switch's answer."""
    return Confirmation(
        id=name, switch="s1", state=state, action="block", event_time=round(at_s * SECOND), arrival=530
    )
