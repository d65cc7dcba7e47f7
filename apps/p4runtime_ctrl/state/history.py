"""Archived decisions and commands that may still be in force.

Each goes with the wall time at which it was written, ns: decisions and commands may be about the same entry, and then
the last word counts.
"""

from collections.abc import Iterable, Sequence
from operator import itemgetter
from typing import Final

from msgspec import structs

from apps.messages import Decision, FloodKind, Intake, TableCommand, Target
from apps.standing_decisions import STANDING, in_force
from due import Item

DECISIONS: Final = ("network.block.firewall.*", "network.protect.firewall.*", "network.meter.firewall.*")

LONGEST_S: Final = 31 * 86_400
"""Older decisions are no longer in force: the firewall's blocks are shorter, or were decided again since."""


def decisions_for(
    switch: str, archived: Iterable[Item], recent: Sequence[tuple[int, Decision]], since: int, intake: Intake
) -> list[tuple[int, Decision]]:
    """Decisions about a switch, and when each was written last: those that lift, then those in force, oldest first.

    Args:
        switch: its name.
        archived: items of decisions; of these, those written after `since`.
        recent: decisions heard live, `as_remembered`, which the archive need not have yet, with their times.
        since: ns since the epoch.
        intake: counts what cannot be read.
    """
    items = sorted(
        (item for item in archived if item.timestamp > since),
        key=lambda item: (item.timestamp, item.sequence),
    )
    archived_ones = ((item, intake.read("decision", Decision.from_item, item)) for item in items)
    found = [(item.timestamp, as_remembered(each)) for item, each in archived_ones if each is not None]
    told = [(at, each) for at, each in [*found, *recent] if not each.dry_run]
    heard = [each for _, each in told]
    lifts = [each for each in heard if each.action not in STANDING]  # of what this controller may still hold
    times: dict[Decision, int] = {}  # a decision may have been said again
    for at, each in told:
        times[each] = max(at, times.get(each, 0))
    return [(times[each], each) for each in [*lifts, *in_force(heard)] if is_for(each, switch)]


def as_remembered(decision: Decision) -> Decision:
    """What an entry is made of: without what led to the decision, which is most of it.

    Args:
        decision: as it was heard.
    """
    return structs.replace(decision, reason="", evidence=(), grounds=())


def is_for(decision: Decision, switch: str) -> bool:
    """Whether the decision is about this switch: by its name, or about all with an empty name or `*`."""
    return decision.switch in ("", "*", switch)


def commands_of(archived: Iterable[Item], since: int, intake: Intake) -> list[tuple[int, TableCommand]]:
    """Commands written after `since` (ns), oldest first."""
    read = (
        (item, intake.read("command", TableCommand.from_item, item))
        for item in archived
        if item.timestamp > since
    )
    return [(item.timestamp, command) for item, command in read if command is not None]


def in_order(
    decisions: Iterable[tuple[int, Decision]], commands: Iterable[tuple[int, TableCommand]]
) -> list[Decision | TableCommand]:
    """Decisions and commands in the order of their times; nothing that stands comes before a lift of its target.

    Args:
        decisions: as `decisions_for` returns them.
        commands: those of the archive, and those heard live, which may be the same.
    """
    lifted: dict[tuple[Target, FloodKind | None, int | None], int] = {}
    told: list[tuple[int, Decision | TableCommand]] = []
    for at, decision in decisions:
        limit = decision.limit
        about = (decision.target, limit.kind if limit else None, limit.port if limit else None)
        last = max(at, lifted.get(about, 0))
        if decision.action in STANDING:
            told.append((last, decision))
        else:
            lifted[about] = last
            told.append((at, decision))
    once = {(at, command.id): command for at, command in commands}
    told += [(at, command) for (at, _), command in once.items()]
    return [each for _, each in sorted(told, key=itemgetter(0))]
