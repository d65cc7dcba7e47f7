"""Answers to a blocked sender are nobody's offence."""

import pytest

from apps.kitsune.blocked import Blocked
from apps.messages import Decision, Target

MAC, ADDRESS = "34:c3:d2:e0:fc:c9", "192.168.2.113"


def decision(
    action: str = "block", kind: str = "mac", address: str = MAC, *, dry_run: bool = False
) -> Decision:
    return Decision.from_value(
        {
            "id": f"{kind}-1",
            "action": action,
            "switch": "s1",
            "target": Target(kind=kind, address=address, port=1).to_value(),  # type: ignore[arg-type]
            "reason": "hot",
            "event_time": 1,
            "expires": 2,
            "dry_run": dry_run,
        }
    )


@pytest.mark.parametrize(("kind", "address"), [("mac", MAC), ("ip", ADDRESS)])
def test_block_covers_its_target_until_it_is_lifted(kind, address):
    """By MAC or by address, on its own switch only."""
    blocked = Blocked()
    assert not blocked
    blocked.decide(decision(kind=kind, address=address))
    assert blocked.covers("s1", MAC, ADDRESS)
    assert not blocked.covers("s2", MAC, ADDRESS)
    blocked.decide(decision("unblock", kind, address))
    assert not blocked.covers("s1", MAC, ADDRESS)


def test_dry_run_blocks_nobody():
    """What is only decided on paper changes nothing."""
    blocked = Blocked()
    blocked.decide(decision(dry_run=True))
    assert not blocked
