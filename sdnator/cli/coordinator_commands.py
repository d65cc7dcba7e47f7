"""`sdnator apps`, `keys` and `flow`: apps, keys and data flow, from the Coordinator's HTTP API."""

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sdnator import app_catalogue
from sdnator.cli.plain_table import plain_table
from sdnator.northbound import ask
from sdnator.up import running

if TYPE_CHECKING:
    from coordinator.matching import Declarations


Url = Annotated[
    str,
    typer.Option(
        help="Coordinator's HTTP API; default: that of the running pipeline.",
        metavar="URL",
        envvar="SDNATOR_COORDINATOR",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="One JSON value on standard output.")]


def apps(*, url: Url = "", as_json: Json = False) -> None:
    """List apps and their instances: state, process, items written and received.

    Example: sdnator apps
    """
    url = url or running.need().coordinator
    found = {"apps": ask(url, "/apps"), "instances": ask(url, "/instances")}
    if as_json:
        print(json.dumps(found))
        return
    epochs = {app["app_id"]: app["epoch"] for app in found["apps"]}
    table = plain_table(
        ("app", "instance", "state", "process", "written", "received", "silent for", "epoch"),
        (
            (
                one["app_id"],
                one["instance_id"],
                one["state"],
                f"{one['pid']} on {one['host']}",
                f"{one['written']:,}",
                f"{one['received']:,}",
                f"{one['silent_s']:.1f} s",
                str(epochs.get(one["app_id"], "")),
            )
            for one in found["instances"]
        ),
    )
    print(table)


def keys(*, url: Url = "", as_json: Json = False) -> None:
    """List all keys with producers, consumers and delivery.

    Example: sdnator keys
    """
    url = url or running.need().coordinator
    found = {
        "capabilities": ask(url, "/capabilities"),
        "interests": ask(url, "/interests"),
        "flow": ask(url, "/flow"),
    }
    if as_json:
        print(json.dumps(found))
        return
    names = ("producer", "delivery", "archive", "consumers", "key")
    print(plain_table(names, _made(found["capabilities"], found["flow"])))
    served = {(flow["consumer"], flow["interest"]) for flow in found["flow"]}
    unserved = [
        (one["app_id"], one["key"])
        for one in found["interests"]
        # keys of the library itself towards the Coordinator are not declared
        if (one["app_id"], one["key"]) not in served and not one["key"].startswith("due.")
    ]
    if unserved:
        print(f"\nwanted, but without a producer\n{plain_table(('wanted by', 'key'), unserved)}")


def _made(
    capabilities: Iterable[Mapping[str, Any]], flows: Iterable[Mapping[str, Any]]
) -> Iterable[tuple[str, ...]]:
    consumers: defaultdict[tuple[str, str], set[str]] = defaultdict(set)
    for flow in flows:
        consumers[flow["producer"], flow["capability"]].add(flow["consumer"])
    for one in sorted(capabilities, key=lambda one: str(one["key"])):
        takers = ", ".join(sorted(consumers[one["app_id"], one["key"]]))
        yield one["app_id"], one["delivery"], one["archive"], takers or "-", one["key"]


def flow(
    *,
    url: Url = "",
    declared: Annotated[
        bool, typer.Option("--declared", help="Show the apps' declarations, even if a pipeline is running.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Draw the data flow: producers, keys, consumers.

    Shows the running pipeline; without one, what the apps declare (INTERESTS and CAPABILITIES).

    Example: sdnator flow
    """
    running_url = "" if declared else url or _running_url()
    flows = ask(running_url, "/flow") if running_url else declared_flows()
    if as_json:
        print(json.dumps({"source": running_url or "declarations", "flow": flows}))
        return
    print(f"data flow {f'of {running_url}' if running_url else 'as the apps declare it'}\n")
    print(draw(flows))


def _running_url() -> str:
    found = running.find()
    return found.coordinator if found is not None else ""


def declared_flows() -> list[dict[str, Any]]:
    """The Coordinator's matching of what the installed apps declare, in its API's form."""
    from coordinator.matching import match

    return [
        {
            "producer": one.producer,
            "consumer": one.consumer,
            "capability": one.capability.key,
            "interest": one.interest.key,
            "delivery": one.capability.delivery,
            "frequency": one.interest.frequency,
        }
        for one in match(declarations()).flows
    ]


def declarations() -> "dict[str, Declarations]":
    """INTERESTS and CAPABILITIES of each installed app."""
    from coordinator.matching import Declarations

    return {app.name: Declarations(app.capabilities, app.interests) for app in app_catalogue.apps()}


def draw(flows: Iterable[Mapping[str, Any]]) -> str:
    """The flow as text: each producer, and below it its keys with their consumers.  ═ is reliable, ─ best effort."""
    taken: defaultdict[str, defaultdict[tuple[str, str], set[str]]] = defaultdict(lambda: defaultdict(set))
    for one in flows:
        taken[one["producer"]][one["capability"], one["delivery"]].add(one["consumer"])
    if not taken:
        return "no data flows: no key has both a producer and a consumer"
    width = max(len(_short(key)) for made in taken.values() for key, _ in made)
    lines: list[str] = []
    for producer in sorted(taken):
        lines.append(producer)
        for key, delivery in sorted(taken[producer]):
            arrow = "══►" if delivery == "reliable" else "──►"
            takers = ", ".join(sorted(taken[producer][key, delivery]))
            lines.append(f"  {_short(key):<{width}} {arrow} {takers}")
        lines.append("")
    return "\n".join([*lines, "══► reliable   ──► best effort"])


def _short(key: str) -> str:
    """A key without its parameters, to keep the picture small."""
    path, colon, _ = key.partition(":")
    return path + (":…" if colon else "")
