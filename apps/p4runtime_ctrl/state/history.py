"""Archived decisions and commands that may still be in force."""

from collections.abc import Iterable, Sequence
from typing import Final

from apps.messages import Decision, Intake, TableCommand
from apps.p4runtime_ctrl.arrivals import command_in, decision_in
from due import Item

DECISIONS: Final = ("network.block.firewall.*", "network.protect.firewall.*", "network.meter.firewall.*")

LONGEST_S: Final = 31 * 86_400
"""Older decisions are no longer in force: the firewall's blocks are shorter, or were decided again since."""


def decisions_for(
    switch: str, archived: Iterable[Item], recent: Sequence[Decision], since: int, intake: Intake
) -> list[Decision]:
    """Decisions about a switch in their order: the archived ones written after `since` (ns), then the
    recent ones that the archive does not have yet."""
    items = sorted(
        (item for item in archived if item.timestamp > since),
        key=lambda item: (item.timestamp, item.sequence),
    )
    found = [decision for item in items if (decision := intake.read("decision", decision_in, item))]
    known = {decision.id for decision in found}
    found += [decision for decision in recent if decision.id not in known]
    return [decision for decision in found if is_for(decision, switch)]


def is_for(decision: Decision, switch: str) -> bool:
    """Whether the decision is about this switch: by its name, or about all with an empty name or `*`."""
    return decision.switch in ("", "*", switch)


def commands_of(archived: Iterable[Item], since: int, intake: Intake) -> list[TableCommand]:
    """Commands written after `since` (ns), oldest first."""
    items = (item for item in archived if item.timestamp > since)
    return [command for item in items if (command := intake.read("command", command_in, item))]
