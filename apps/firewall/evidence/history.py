"""A sender's history from archived items.  Pure."""

from collections.abc import Container, Iterable, Iterator, Sequence
from typing import Any, Final, NamedTuple

from apps.messages import Action, Decision, FalseAlarm, Instruction, MessageError, Target
from due import Item


class EarlierBlocks(NamedTuple):
    """What the archive knows of a target: its earlier blocks."""

    times: int = 0
    """How often it was blocked."""
    first: int = 0
    """Capture time of the first, ns."""
    last: int = 0
    """Capture time of the last, ns."""


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


def count_offences(items: Iterable[Item], target: Target, before: int, excused: Container[str] = ()) -> int:
    """Number of earlier blocks of the target; see `earlier_blocks`."""
    return earlier_blocks(items, target, before, excused).times


def earlier_blocks(
    items: Iterable[Item], target: Target, before: int, excused: Container[str] = ()
) -> EarlierBlocks:
    """Earlier blocks of the target, counted by decision; neither extensions nor the excused ones are offences.

    Args:
        items: from the archive.
        target: what was blocked.
        before: capture time, ns; later blocks do not count.
        excused: ids of decisions that were false alarms.
    """
    began: dict[str, int] = {}
    for decision in _readable(items):
        if decision.target == target and decision.event_time < before and not decision.dry_run:
            began[decision.id] = min(decision.event_time, began.get(decision.id, decision.event_time))
    times = [at for name, at in began.items() if name not in excused]
    return EarlierBlocks(len(times), min(times), max(times)) if times else EarlierBlocks()


DECISIONS: Final = (
    "network.block.firewall.*",
    "network.block_prefix.firewall.*",
    "network.protect.firewall.*",
    "network.meter.firewall.*",
)
FAMILIES: Final[dict[Action, str]] = {
    "block": "block",
    "unblock": "block",
    "protect": "protect",
    "unprotect": "protect",
    "meter": "meter",
    "unmeter": "meter",
}
"""The segment of a decision's key by its action; prefixes are blocked under `block_prefix`."""
ANSWERS: Final = "network.answer.firewall"
"""`<ANSWERS>.<who asked>`"""
INSTRUCTIONS: Final = "network.instruction.*.firewall"


LESSONS: Final = "network.false_alarm.firewall.*"


def lesson_key(lesson: FalseAlarm) -> str:
    """The key of a lesson: `taught`, or `revoked`."""
    return f"network.false_alarm.firewall.{'revoked' if lesson.revoked else 'taught'}"


def answer_key(instruction: str) -> str:
    """The key of the answer to an instruction that came under this key."""
    return f"{ANSWERS}.{instruction.split('.')[2]}"


def instructions_in(items: Iterable[Item]) -> list[Instruction]:
    """Archived instructions in order, without malformed ones."""
    found = []
    for item in items:
        try:
            found.append(Instruction.from_value(item.value))
        except MessageError:
            continue
    return found


def carried_out(instructions: Iterable[Instruction], done: Container[str]) -> list[Instruction]:
    """Without instructions with a deadline that no firewall carried out: their sender was told that nothing was done."""
    return [each for each in instructions if not each.expires or each.id in done]


def decisions_in(items: Iterable[Item]) -> list[Decision]:
    """Archived decisions in the order they were written, by the writers' clocks; `in_force` says which of them stand.

    Dry runs and malformed items are left out.
    """
    ordered = sorted(items, key=lambda item: (item.timestamp, item.sequence))
    return [decision for decision in _readable(ordered) if not decision.dry_run]


def _readable(items: Iterable[Item]) -> Iterator[Decision]:
    for item in items:
        try:
            yield Decision.from_value(item.value)
        except MessageError:
            continue


def allowed_by(instructions: Iterable[Instruction], beforehand: Iterable[str] = ()) -> tuple[str, ...]:
    """The allow-list from the settings and from instructions since."""
    entries = dict.fromkeys(beforehand)
    for instruction in instructions:
        if instruction.verb == "allow":
            entries[instruction.subject] = None
        elif instruction.verb == "disallow":
            entries.pop(instruction.subject, None)
    return tuple(entries)
