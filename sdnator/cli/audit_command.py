"""`sdnator audit`: who did what, from Data Archives."""

import json
import time
from collections.abc import Iterator
from typing import Annotated, Any

import typer

from apps.messages import Instruction, MessageError
from due import Item
from sdnator.blocks.blocks_archive import find
from sdnator.cli.due_commands import Archive
from sdnator.cli.plain_table import plain_table
from sdnator.notation import instant_ns
from sdnator.rights.audited_deed import AUDITED, AuditedDeed

_INSTRUCTIONS = "network.instruction.*.*"
_PAGE = "dashboard"
"""Its instructions stand among the deeds, with the name of the user who gave them."""


def audit(
    *,
    since: Annotated[
        str, typer.Option(help="Since: 1h or 7d ago, or a local time such as 2024-05-01T12:00.")
    ] = "7d",
    who: Annotated[str, typer.Option(help="Only what this user or app did.", metavar="NAME")] = "",
    archive: Archive = "",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Show the audit trail: sign-ins, refusals, changes of users and apps, instructions to firewall and detector.

    Oldest first. Users of the dashboard appear by name, those of the command line by the name of their Unix user; other
    names are apps.

    Example: sdnator audit --since 24h
    """
    start = instant_ns(since, time.time_ns(), "--since") if since else 0
    deeds = [one for one in _deeds(archive, start) if who in ("", one["who"])]
    if as_json:
        print(json.dumps({"deeds": deeds}))
    elif not deeds:
        print("nothing was recorded in that time")
    else:
        rows = ((_clock(one["time"]), one["who"], one["source"] or "-", one["deed"]) for one in deeds)
        print(plain_table(("time", "who", "from", "what"), rows))


def _deeds(archive: str, start: int) -> Iterator[dict[str, Any]]:
    query = {"timestamp": {"$gte": start}}
    items = [item for key in (AUDITED, _INSTRUCTIONS) for item in find(archive, {"dataKey": key, **query})]
    named = {str(item.value.get("instruction") or "") for item in items if _is_deed(item)} - {""}
    for item in sorted(items, key=lambda one: one.timestamp):
        if not _is_deed(item) and isinstance(item.value, dict) and str(item.value.get("id")) in named:
            continue  # it stands there with the name of whoever gave it
        try:
            found = _deed(item)
        except MessageError:  # an app of somebody else wrote it
            continue
        if found is not None:
            yield found


def _is_deed(item: Item) -> bool:
    return ".audit." in item.key and isinstance(item.value, dict)


def _deed(item: Item) -> dict[str, Any] | None:
    if ".audit." in item.key:
        one = AuditedDeed.from_value(item.value)
        return {"time": item.timestamp, "who": one.who, "source": one.source, "deed": one.deed}
    said = Instruction.from_value(item.value)
    if item.app_id == _PAGE:
        return None
    words = " ".join(filter(None, (said.verb, said.subject, f"({said.reason})" if said.reason else "")))
    return {"time": item.timestamp, "who": item.app_id, "source": "", "deed": words}


def _clock(time_ns: int) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(time_ns / 1e9))
