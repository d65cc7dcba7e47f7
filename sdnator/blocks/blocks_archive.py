"""Blocks, guards and rate limits in Data Archives, read and written without a running pipeline."""

import time
from contextlib import closing
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit
from uuid import uuid4

from apps.firewall.enforcement.switch_entries import KEPT, is_prefix, prefix_update
from apps.firewall.evidence.history import DECISIONS, FAMILIES, decisions_in
from apps.messages import Decision, Instruction, TableCommand
from apps.standing_decisions import in_force
from due import DueError, Item
from due.backends import open_archive
from sdnator.errors import BadInput
from sdnator.northbound import is_file
from sdnator.up import running

INSTRUCTION: Final = "network.instruction.operator.firewall"
_LIFTS: Final = {"block": "unblock", "protect": "unprotect", "meter": "unmeter"}


def readable(archive: str) -> str:
    """URL of the archive to read; empty: there is no default archive yet.

    Raises:
        BadInput: the named file does not exist; the driver would create it, and show no blocks.
    """
    url = running.archive_url(archive)
    parts = urlsplit(url)
    if parts.scheme != "sqlite" or not parts.path or is_file(Path(unquote(parts.path))):
        return url
    if url == running.default_archive():
        return ""
    raise BadInput(
        f"{url}: there is no such archive; check the path (--archive, $DUE_ARCHIVE), or leave it out for the "
        "running pipeline's"
    )


def find(archive: str, query: str | dict[str, Any]) -> list[Item]:
    """Items of a key or query, oldest first; raises `BadInput` for an archive that does not answer."""
    url = readable(archive)
    if not url:
        return []
    try:
        with closing(open_archive(url)) as driver:
            return driver.find({"dataKey": query} if isinstance(query, str) else query)
    except DueError as error:
        raise BadInput(f"{url}: {error}") from error


def all_decisions(archive: str) -> list[Decision]:
    """Every decision ever written, in order; dry runs are left out."""
    return decisions_in(item for key in DECISIONS for item in find(archive, key))


def key_of(decision: Decision) -> str:
    """The key that a decision is written under."""
    family = FAMILIES[decision.action]
    if is_prefix(decision.target) and family == "block":
        family = "block_prefix"
    kind = "ipv6" if ":" in decision.target.address else "ipv4"
    return f"network.{family}.firewall.{'mac' if decision.target.kind == 'mac' else kind}"


def lift_in_archive(archive: str) -> list[Decision]:
    """Lift every decision in force, in the archive; returns these decisions.

    Guards that the firewall's settings name stay.  Raises `BadInput`.
    """
    standing = [each for each in in_force(all_decisions(archive)) if not _is_settled(each)]
    now, instance = time.time_ns(), uuid4().hex[:16]
    asked = Instruction(id=uuid4().hex[:12], verb="panic", reason="panic without Data Updates")
    items = [Item(INSTRUCTION, asked.to_value(), now, now, "operator", instance, 1)]
    for number, decision in enumerate(standing, start=2):
        value = decision.to_value() | {
            "action": _LIFTS[decision.action],
            "reason": "panic",
            "event_time": now,
        }
        items.append(Item(key_of(decision), value, now + number, now, "firewall", instance, number))
    items += _deletions(archive, standing, now, instance, len(items))
    url = readable(archive)
    if not url:
        return []
    try:
        with closing(open_archive(url)) as driver:
            driver.insert(items)
    except DueError as error:
        raise BadInput(f"{url}: {error}") from error
    return standing


def _deletions(archive: str, lifted: list[Decision], now: int, instance: str, used: int) -> list[Item]:
    """Blocks of prefixes are commands, which controllers restore from the archive, too."""
    prefixes = {each.id: each.target.address for each in lifted if is_prefix(each.target)}
    kept = find(archive, f"{KEPT}.*") if prefixes else []
    asked = {(item.key, item.value["id"]) for item in kept if item.value.get("id") in prefixes}
    return [
        Item(key, _deletion(name, prefixes[name]), now + number, now, "firewall", instance, number)
        for number, (key, name) in enumerate(sorted(asked), start=used + 1)
    ]


def _deletion(name: str, prefix: str) -> dict[str, Any]:
    return TableCommand(id=name, updates=(prefix_update("delete", prefix),)).to_value()


def _is_settled(decision: Decision) -> bool:
    """A guard that the settings name has no end."""
    return decision.action == "protect" and decision.expires == 0
