"""DUE items → what enforcers work with.  Pure; raises `MessageError` only."""

from collections.abc import Iterable, Sequence
from typing import Final

from apps.enforcement import AllowedEntries
from apps.enforcers.desired_blocks import AllowedSenders
from apps.messages import Decision, Intake, MessageError, sender_of
from apps.standing_decisions import STANDING
from due import Item

DECISIONS: Final = ("network.block.firewall.*", "network.block_prefix.firewall.*")


def decision_in(item: Item) -> tuple[Decision, int]:
    """A block or unblock, and the wall time (ns) at which it was written."""
    sender_of(item)
    return Decision.from_value(item.value), item.timestamp


def allowed_in(item: Item) -> tuple[str, ...]:
    """`network.allowed.firewall`."""
    sender_of(item)
    entries = AllowedEntries.from_value(item.value).entries
    try:
        AllowedSenders().replace(entries)
    except ValueError as error:
        raise MessageError("range", f"allow-list: {error}") from None
    return entries


def last_of_each(items: Iterable[Item], intake: Intake) -> list[tuple[Decision, int]]:
    """The last decision of each id, in the order in which they were written; dry runs are left out.

    A lift is the last whatever clock its writer had.
    """
    latest: dict[str, tuple[Decision, int]] = {}
    ordered: Sequence[Item] = sorted(items, key=lambda item: (item.timestamp, item.sequence))
    for item in ordered:
        found = intake.read("decision", decision_in, item)
        if found is None or found[0].dry_run:
            continue
        held = latest.get(found[0].id)
        if held is None or found[0].action not in STANDING or held[0].action in STANDING:
            latest.pop(found[0].id, None)
            latest[found[0].id] = found
    return list(latest.values())
