"""DUE items → what they say: decisions and commands, as they come and out of Data Archives."""

import logging
from collections.abc import Iterable, Sequence
from typing import Final, TypeVar

import msgspec

from apps.messages import Decision, Message, TableCommand
from due import Item

DECISIONS: Final = ("network.block.firewall.*", "network.protect.firewall.*")

_LOG = logging.getLogger(__name__)
_MessageT = TypeVar("_MessageT", bound=Message)


def read(kind: type[_MessageT], item: Item) -> _MessageT | None:
    """A message out of an item; None, and a line in the log, where it is none."""
    try:
        return kind.from_value(item.value)
    except msgspec.ValidationError as error:
        _LOG.warning("%s: not a %s: %s", item.key, kind.__name__, error)
        return None


def decisions_for(
    switch: str, archived: Iterable[Item], recent: Sequence[Decision], since: int
) -> list[Decision]:
    """Decisions about a switch in their order: the archived ones written after `since` (ns), then the
    recent ones that the archive does not have yet."""
    items = sorted(
        (item for item in archived if item.timestamp > since),
        key=lambda item: (item.timestamp, item.sequence),
    )
    found = [decision for item in items if (decision := read(Decision, item)) is not None]
    known = {decision.id for decision in found}
    found += [decision for decision in recent if decision.id not in known]
    return [decision for decision in found if is_for(decision, switch)]


def is_for(decision: Decision, switch: str) -> bool:
    """Whether the decision is about this switch: by its name, or about all with an empty name or `*`."""
    return decision.switch in ("", "*", switch)


def commands_of(archived: Iterable[Item], since: int) -> list[TableCommand]:
    """Commands written after `since` (ns), oldest first."""
    items = (item for item in archived if item.timestamp > since)
    return [command for item in items if (command := read(TableCommand, item)) is not None]
