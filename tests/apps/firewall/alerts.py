"""Alerts as Kitsune writes them, for the firewall's tests."""

from typing import Any

from apps.messages import Alert, Sender

SECOND = 1_000_000_000
CAMERA = Sender(switch="s1", port=1, mac="5c:cf:7f:05:f2:c6", ip="192.168.2.108")


def alert(at_s: int = 100, sender: Sender = CAMERA, **changes: Any) -> Alert:
    """An alert of a camera that is hot for the fifth second."""
    fields: dict[str, Any] = {
        "id": f"a{at_s}",
        "sender": sender,
        "event_time": at_s * SECOND,
        "first_packet": 1_000,
        "packets": 50,
        "over": 45,
        "peak_score": 12.5,
        "anomalous_seconds": 5,
        "rate": 50.0,
        "training_rate": 20.0,
        "mac_addresses": 1,
        "role": "host",
        "reason": "192.168.2.108 sends to 40 times more hosts than in training",
    }
    return Alert(**(fields | changes))
