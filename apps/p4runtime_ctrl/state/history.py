"""Archived decisions and commands that may still be in force."""

from collections.abc import Iterable, Sequence
from typing import Final

from msgspec import structs

from apps.messages import Decision, Intake, TableCommand
from apps.standing_decisions import STANDING, in_force
from due import Item

DECISIONS: Final = ("network.block.firewall.*", "network.protect.firewall.*", "network.meter.firewall.*")

LONGEST_S: Final = 31 * 86_400
"""Older decisions are no longer in force: the firewall's blocks are shorter, or were decided again since."""


def decisions_for(
    switch: str, archived: Iterable[Item], recent: Sequence[Decision], since: int, intake: Intake
) -> list[Decision]:
    """Decisions about a switch: those that lift, then those in force, oldest first.

    Args:
        switch: its name.
        archived: items of decisions; of these, those written after `since`.
        recent: decisions heard live, `as_remembered`, which the archive need not have yet.
        since: ns since the epoch.
        intake: counts what cannot be read.
    """
    items = sorted(
        (item for item in archived if item.timestamp > since),
        key=lambda item: (item.timestamp, item.sequence),
    )
    archived_ones = (intake.read("decision", Decision.from_item, item) for item in items)
    found = [as_remembered(decision) for decision in archived_ones if decision is not None]
    heard = [each for each in [*found, *recent] if not each.dry_run]
    lifts = [each for each in heard if each.action not in STANDING]  # of what this controller may still hold
    return [each for each in [*lifts, *in_force(heard)] if is_for(each, switch)]


def as_remembered(decision: Decision) -> Decision:
    """What an entry is made of: without what led to the decision, which is most of it.

    Args:
        decision: as it was heard.
    """
    return structs.replace(decision, reason="", evidence=(), grounds=())


def is_for(decision: Decision, switch: str) -> bool:
    """Whether the decision is about this switch: by its name, or about all with an empty name or `*`."""
    return decision.switch in ("", "*", switch)


def commands_of(archived: Iterable[Item], since: int, intake: Intake) -> list[TableCommand]:
    """Commands written after `since` (ns), oldest first."""
    items = (item for item in archived if item.timestamp > since)
    return [command for item in items if (command := intake.read("command", TableCommand.from_item, item))]
