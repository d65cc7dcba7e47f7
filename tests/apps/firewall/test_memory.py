"""What the firewall keeps of senders and decisions: little of each, and nothing of what is over."""

import gc
import tracemalloc
from typing import Any

import msgspec

from apps.messages import Confirmation, Sender
from tests.apps.firewall.alerts import alert
from tests.apps.firewall.desk import ALERT, NOW, Desk

SECOND = 1_000_000_000
CONFIRMED = "network.confirmation.p4runtime_ctrl"
EVIDENCE = "network.evidence.kitsune"
SENDERS = 200
BOUND = 7_500
"""Bytes."""


def fresh(value: Any) -> Any:
    """A message as it comes from the network: each with texts of its own."""
    return msgspec.msgpack.decode(msgspec.msgpack.encode(value))


def accuse(desk: Desk, number: int, times: int = 12) -> None:
    """Alerts and evidence against a sender behind a router, as Kitsune writes them."""
    ip = f"198.51.{number // 256}.{number % 256}"
    sender: dict[str, Any] = {"switch": "s1", "port": 2, "mac": "02:11:00:00:00:01", "ip": ip}
    for time in range(times):
        at = NOW + time * SECOND
        words = f"{ip} sends to {time} times more hosts than in training; " + "x" * 200
        said = fresh(alert(sender=Sender(**sender), reason=words).to_value())
        desk.hand(ALERT, said | {"event_time": at}, pattern=ALERT, at=at)
        piece = {
            "id": f"kitsune-scores-{at}-{number}",
            "kind": "unlike_training",
            "source": "scores",
            "sender": sender,
            "supporting": True,
            "victims": ["10.0.0.1"],
            "victim_count": 1,
            "nats": 0.5,
            "since": at - SECOND,
            "event_time": at,
            "packets": 5,
            "mac_addresses": 800,
            "text": f"the packets of {ip} are unlike those of training (3 nats within 1 s)",
        }
        desk.hand(f"{EVIDENCE}.scores", fresh(piece), pattern=f"{EVIDENCE}.*", at=at)


def test_a_sender_takes_few_kilobytes() -> None:
    """Thousands are accused within an hour, each with the last pieces of evidence, its sums and its incident."""
    desk = Desk(rule="sequential")
    accuse(desk, SENDERS)
    tracemalloc.start()
    try:
        for number in range(SENDERS):
            accuse(desk, number)
        desk.engine.written.clear()
        gc.collect()
        each = tracemalloc.get_traced_memory()[0] / SENDERS
    finally:
        tracemalloc.stop()
    assert each < BOUND


def test_commands_are_not_followed_like_decisions() -> None:
    """The switch confirms every known source and every query under the same key."""
    desk = Desk()
    for number in range(100):
        said = Confirmation(
            id=f"firewall-{number}", switch="s1", state="installed", action="insert", event_time=NOW
        )
        desk.hand(f"{CONFIRMED}.s1", said.to_value(), pattern=f"{CONFIRMED}.*")
    assert len(desk.service._enforcers) == 0
