"""`sdnator explain KEY`: from the wish to the archive in one view, of a running pipeline.

wanted ─► Coordinator ─► adapter: plan ─► switch: entries, counters ─► what came back ─► results ─► archive
"""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from typing import Annotated, Any, Final

import typer

from sdnator.cli.coordinator_commands import Url
from sdnator.cli.due_commands import Archive, KeyArgument, Updates
from sdnator.cli.plain_table import plain_table
from sdnator.cli.plan_question import ask_plan, is_asked_of_adapter
from sdnator.cli.switch_place import Insecure, place_of
from sdnator.errors import PipelineError
from sdnator.northbound import ask, latest
from sdnator.notation import brief, local_time, typed_key
from sdnator.up import running

_BY_BIT: Final = "@{}"
"""How an entry of a counting stage ends: its priority is its bit and one."""

Section = dict[str, Any]


def explain(
    key: KeyArgument,
    *,
    updates: Updates = "",
    archive: Archive = "",
    url: Url = "",
    switch: Annotated[
        list[str] | None,
        typer.Option(help="HOST:PORT or name of a switch; default: all of the pipeline.", metavar="SWITCH"),
    ] = None,
    insecure: Insecure = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Explain a key: who wants it, who produces it and at what rate, its plan and cost, its results and their archive.

    Example: sdnator explain network.traffic_query.sonata.new_tcp:threshold=10
    """
    wanted = typed_key(key)
    found = None if updates and archive and url else running.need()
    told = ask_plan(wanted, updates or _of(found).updates, answers=2) if is_asked_of_adapter(wanted) else []
    plan = dict(told[-1]) if told else {}
    output = str(plan.get("output") or wanted)
    shown: Section = {
        "key": wanted,
        "coordinator": _coordinator(url or _of(found).coordinator, wanted),
        "plan": _without_times(plan),
        "switches": _switches(plan, switch, insecure) if plan.get("state") == "running" else [],
        "cost": _cost(told) if plan.get("state") == "running" else {},
        "archive": _archived(archive or _of(found).archive, output),
    }
    print(json.dumps(shown) if as_json else "\n".join(_text(shown)))


def _of(found: running.Running | None) -> running.Running:
    return found if found is not None else running.need()


def _coordinator(url: str, key: str) -> Section:
    """Who wants the key, who produces it, and at what rate."""
    from due import Key

    this = Key.parse(key)
    interests = [
        one
        for one in ask(url, "/interests")
        if one["key"] == key or (this.concrete and Key.parse(one["key"]).matches(this))
    ]
    keys = {one["key"] for one in interests}
    flows = [one for one in ask(url, "/flow") if one["interest"] in keys]
    if not flows:
        flows = [
            {"producer": one["app_id"], "capability": one["key"], "delivery": one["delivery"], "consumer": ""}
            for one in ask(url, "/capabilities")
            if Key.parse(one["key"]).offers(this)
        ]
    assignments = ask(url, "/assignments")
    return {
        "wanted_by": [{name: one.get(name) for name in ("app_id", "key", "frequency")} for one in interests],
        "made_by": [
            {name: one.get(name) for name in ("producer", "capability", "delivery", "consumer")}
            for one in flows
        ],
        "assigned": [
            {"app_id": app["app_id"], "active": app["active"], "epoch": app["epoch"], **one}
            for app in assignments
            for one in app["assignments"]
            if one["key"] in keys
        ],
        "incompatible": [
            {"app_id": app["app_id"], **one}
            for app in assignments
            for one in app["incompatible"]
            if one["key"] == key
        ],
    }


def _without_times(plan: Section) -> Section:
    return {name: value for name, value in plan.items() if name not in ("monotonic_s", "adapter_cpu_s")}


def _switches(plan: Mapping[str, Any], chosen: Sequence[str] | None, insecure: bool) -> list[Section]:
    """The entries of the plan in each switch, with handle and counter; a switch that does not answer says so."""
    from sdnator.cli.switch_commands import read_tables

    if chosen is None:
        found = running.need()
        chosen = [str(one["name"]) for one in (found.switches or [found.switch])]
    shown: list[Section] = []
    for name in chosen:
        place = place_of(name, 1, insecure=insecure)
        try:
            rows = {
                table: read_tables(place, table)[1]
                for table in sorted({entry["table"] for entry in plan["entries"]})
            }
        except PipelineError as error:
            shown.append({"switch": place.name, "entries": [], "error": str(error)})
            continue
        shown.append({"switch": place.name, "entries": list(_entries(plan, rows)), "error": ""})
    return shown


def _entries(plan: Mapping[str, Any], rows: Mapping[str, Sequence[Section]]) -> Iterator[Section]:
    for entry in plan["entries"]:
        end = _BY_BIT.format(entry["bit"] + 1)
        held = next((row for row in rows[entry["table"]] if row["entry"].endswith(end)), None)
        yield {
            **{name: entry[name] for name in ("role", "bit", "match", "cells")},
            "handle": held["entry"] if held is not None else "",
            "packets": held.get("packets") if held is not None else None,
        }


def _cost(told: Sequence[Mapping[str, Any]]) -> Section:
    """Rates between the first and the last answer, a second."""
    first, last = told[0], told[-1]
    seconds = max(1e-3, last["monotonic_s"] - first["monotonic_s"])
    before = first.get("came", {})
    rates = {
        f"{name}_per_s": round((last["came"][name] - before.get(name, 0)) / seconds, 1)
        for name in ("copies", "reports")
    }
    cpu = (last["adapter_cpu_s"] - first["adapter_cpu_s"]) / seconds
    return {
        **rates,
        "results_per_s": round((last["results"] - first["results"]) / seconds, 1),
        "adapter_cpu_share": round(cpu, 3),
        "seconds": round(seconds, 2),
    }


def _archived(url: str, key: str) -> Section:
    """Where results are kept, and the last one."""
    from due.backends import open_archive
    from due.errors import DueError
    from sdnator.redaction import redacted

    try:
        with closing(open_archive(url)) as driver:
            items, _ = latest(driver.find, {"dataKey": key}, 0, time.time_ns() + 1, 1)
    except DueError as error:
        return {"where": redacted(url), "key": key, "last": None, "error": str(error)}
    last = {"at": items[-1].event_time, "value": _plain(items[-1].value)} if items else None
    return {"where": redacted(url), "key": key, "last": last}


def _plain(value: Any) -> Any:
    from coordinator.views import value as as_json

    return as_json(brief(value))


def _text(shown: Section) -> Iterator[str]:
    yield shown["key"]
    parts: tuple[tuple[str, Callable[[Section], Iterator[str]]], ...] = (
        ("wanted", _wanted_lines),
        ("plan", _plan_lines),
        ("in the switch", _switch_lines),
        ("what came back", _came_lines),
        ("archive", _archive_lines),
    )
    for title, lines in parts:
        found = list(lines(shown))
        if found:
            yield f"\n{title}"
            yield from (f"  {line}" for each in found for line in each.splitlines())


def _wanted_lines(shown: Section) -> Iterator[str]:
    known = shown["coordinator"]
    for one in known["wanted_by"]:
        rate = "" if one["frequency"] is None else f", at {one['frequency']} Hz"
        yield f"{one['app_id']} wants {one['key']}{rate}"
    if not known["wanted_by"]:
        yield "nobody wants it; `sdnator observe` would, while it runs"
    for capability, delivery, producer in dict.fromkeys(
        (one["capability"], one["delivery"], one["producer"]) for one in known["made_by"]
    ):
        yield f"{producer} produces {capability} ({delivery})"
    if not known["made_by"]:
        yield "no app produces it; `sdnator keys` shows what is produced"
    for one in known["assigned"]:
        rate = "every item" if one["frequency"] is None else f"{one['frequency']:g} Hz"
        yield f"assigned to {one['app_id']} (instance {one['active']}, epoch {one['epoch']}): {rate}"
    for one in known["incompatible"]:
        yield f"not served to {one['app_id']}: {one['reason']}"


def _plan_lines(shown: Section) -> Iterator[str]:
    plan = shown["plan"]
    if not plan:
        return
    if plan["state"] in ("refused", "follows"):
        yield f"{plan['state']}: {plan['reason']}"
        return
    if "auto" in plan:
        yield plan["auto"]["text"]
    yield "in force" if plan["state"] == "running" else "not in force; if somebody wanted it now:"
    rows = [(one["text"].removeprefix("    "), one["place"], one["why"]) for one in plan["operators"]]
    yield plain_table(("operator", "runs", "why"), rows)
    if not plan["in_switch"]:
        yield f"on the host, because {plan['reason']}"
    yield f"beside {plan['others']} other queries"


def _switch_lines(shown: Section) -> Iterator[str]:
    for copy in shown["plan"].get("copies", ()):
        what = "frames" if copy["payload"] else "headers"
        yield f"bit {copy['bit']} copies {what} of {copy['match']}"
    for one in shown["switches"]:
        if one["error"]:
            yield f"{one['switch']}: {one['error']}"
        rows = [
            (one["switch"], each["role"], _count(each["packets"]), each["handle"] or "not in the switch")
            for each in one["entries"]
        ]
        if rows:
            yield plain_table(("switch", "role", "frames", "entry"), rows)


def _count(number: int | None) -> str:
    return "-" if number is None else f"{number:,}"


def _came_lines(shown: Section) -> Iterator[str]:
    cost, plan = shown["cost"], shown["plan"]
    if not cost:
        return
    came = plan["came"]
    yield f"copies   {came['copies']:>12,}  {cost['copies_per_s']:>10,.1f} a second"
    yield f"reports  {came['reports']:>12,}  {cost['reports_per_s']:>10,.1f} a second"
    yield f"results  {plan['results']:>12,}  {cost['results_per_s']:>10,.1f} a second"
    if came["overflow"]:
        yield f"{came['overflow']:,} of the reports because a key had no cell"
    if came["late_reads"]:
        yield f"{came['late_reads']:,} cells were read too late"
    yield f"host: the adapter uses {cost['adapter_cpu_share']:.1%} of a core for all its queries"


def _archive_lines(shown: Section) -> Iterator[str]:
    found = shown["archive"]
    yield f"{found['where']}, under {found['key']}"
    if found.get("error"):
        yield found["error"]
    elif found["last"] is None:
        yield "no result is archived yet"
    else:
        when = local_time(found["last"]["at"], fraction=True)
        yield f"last: {when}  {json.dumps(found['last']['value'], ensure_ascii=False)}"
