"""What the archive says of a sender: pure reading of archived items."""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import msgspec

from apps.messages import Decision, Instruction, Target
from due import Item


def offences_query(target: Target) -> dict[str, Any]:
    """The archive query for earlier blocks of a target."""
    return {
        "dataKey": "network.block_prefix.firewall.*" if "/" in target.address else "network.block.firewall.*",
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


DECISIONS: Final = (
    "network.block.firewall.*",
    "network.block_prefix.firewall.*",
    "network.protect.firewall.*",
)
ANSWERS: Final = "network.answer.firewall"
"""`<ANSWERS>.<who asked>`"""
INSTRUCTIONS: Final = "network.instruction.*.firewall"


def newer_than(key: str, timestamp: int) -> dict[str, Any]:
    """The archive query for items of a key written after a time, ns."""
    return {"dataKey": key, "timestamp": {"$gt": timestamp}}


def instructions_in(items: Iterable[Item]) -> list[Instruction]:
    """Archived instructions in order; what is none is left out, as it was when it came."""
    found = []
    for item in items:
        try:
            found.append(Instruction.from_value(item.value))
        except msgspec.ValidationError:
            continue
    return found


def decisions_in(items: Iterable[Item]) -> list[Decision]:
    """Archived decisions in the order they were written; dry runs change nothing and are left out."""
    ordered = sorted(items, key=lambda item: (item.timestamp, item.sequence))
    return [made for item in ordered if not (made := Decision.from_value(item.value)).dry_run]


def in_force(decisions: Iterable[Decision]) -> list[Decision]:
    """What the decisions come to: the latest for each target on each switch, unless it lifts.

    Expired ones are in: whether they end or go on is for the firewall to say.
    """
    latest: dict[tuple[str, Target], Decision] = {}
    for decision in decisions:
        key = (decision.switch, decision.target)
        latest.pop(key, None)
        if decision.action in ("block", "protect"):
            latest[key] = decision
    return list(latest.values())


def allowed_by(instructions: Iterable[Instruction], beforehand: Iterable[str] = ()) -> tuple[str, ...]:
    """The allow-list that follows from the settings and from what people said since."""
    entries = dict.fromkeys(beforehand)
    for instruction in instructions:
        if instruction.verb == "allow":
            entries[instruction.subject] = None
        elif instruction.verb == "disallow":
            entries.pop(instruction.subject, None)
    return tuple(entries)
