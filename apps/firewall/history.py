"""What the archive says of a sender: pure reading of archived items."""

from collections.abc import Iterable, Sequence
from typing import Any

from apps.messages import Decision, Target
from due import Item


def offences_query(target: Target) -> dict[str, Any]:
    """The archive query for earlier blocks of a target."""
    return {
        "dataKey": "network.block.firewall.*",
        "value.action": "block",
        "value.target.address": target.address,
    }


def offences_of_many(addresses: Sequence[str]) -> dict[str, Any]:
    """The archive query for earlier blocks of any of the addresses."""
    return {
        "dataKey": "network.block.firewall.*",
        "value.action": "block",
        "value.target.address": {"$in": list(addresses)},
    }


def count_offences(items: Iterable[Item], target: Target, before: int) -> int:
    """Earlier blocks of the target, counted by decision: an extension is no new offence."""
    ids = set()
    for item in items:
        decision = Decision.from_value(item.value)
        if decision.target == target and decision.event_time < before and not decision.dry_run:
            ids.add(decision.id)
    return len(ids)
