"""`sdnator apps`, `keys` and `flow`: who is here, who makes and wants what, over the Coordinator's HTTP API."""

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sdnator import running
from sdnator.errors import BadInput, PipelineError
from sdnator.plain_table import plain_table

if TYPE_CHECKING:
    from coordinator.matching import Declarations

APPS = ("p4runtime_ctrl", "kitsune", "sonata_adapter", "firewall")
"""Those whose INTERESTS and CAPABILITIES `flow` draws where no pipeline runs."""
_SECONDS = 5.0

Url = Annotated[
    str,
    typer.Option(
        help="Coordinator's HTTP API; default: that of the running pipeline.",
        metavar="URL",
        envvar="SDNATOR_COORDINATOR",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="One JSON value on standard output.")]


def ask(url: str, path: str) -> Any:
    """The JSON answer of the API.  Raises BadInput for a URL that is none, PipelineError without an answer."""
    import http.client
    from urllib.error import URLError
    from urllib.request import ProxyHandler, build_opener

    if not url.startswith(("http://", "https://")):
        raise BadInput(f"--url {url}: give http://HOST:PORT of a Coordinator")
    opener = build_opener(ProxyHandler({}))  # it is on loopback: a proxy would ask the wrong machine
    try:
        with opener.open(url.rstrip("/") + path, timeout=_SECONDS) as answer:
            return json.load(answer)
    except (URLError, OSError, ValueError, http.client.HTTPException) as error:
        cause = getattr(error, "reason", None) or error
        raise PipelineError(
            f"no Coordinator answers at {url}{path} ({cause}); see `sdnator status`"
        ) from None


def apps(*, url: Url = "", as_json: Json = False) -> None:
    """Apps and their instances: state, process, items written and received.

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
    """All keys: who can make them, who wants them, and how they travel.

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
    names = ("made by", "delivery", "archive", "goes to", "key")
    print(plain_table(names, _made(found["capabilities"], found["flow"])))
    served = {(flow["consumer"], flow["interest"]) for flow in found["flow"]}
    unserved = [
        (one["app_id"], one["key"])
        for one in found["interests"]
        # what the library itself says to the Coordinator is declared by nobody
        if (one["app_id"], one["key"]) not in served and not one["key"].startswith("due.")
    ]
    if unserved:
        print(f"\nwanted, but made by nobody\n{plain_table(('wanted by', 'key'), unserved)}")


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
        bool, typer.Option("--declared", help="Of the apps' own declarations, even if a pipeline runs.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Draw who gets what from whom.

    Of the running pipeline; where none runs, of what the apps declare at the head of their service.py.

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
    """As the Coordinator would match what the apps of this product declare, in its API's form."""
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
    """INTERESTS and CAPABILITIES of each app."""
    from importlib import import_module

    from coordinator.matching import Declarations

    found = {}
    for name in APPS:
        service = import_module(f"apps.{name}.service")
        found[name] = Declarations(tuple(service.CAPABILITIES), tuple(service.INTERESTS))
    return found


def draw(flows: Iterable[Mapping[str, Any]]) -> str:
    """The flow as text: each producer, below it its keys and who takes them.  ═ is reliable, ─ best effort."""
    taken: defaultdict[str, defaultdict[tuple[str, str], set[str]]] = defaultdict(lambda: defaultdict(set))
    for one in flows:
        taken[one["producer"]][one["capability"], one["delivery"]].add(one["consumer"])
    if not taken:
        return "nothing flows: nobody wants what is made"
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
    """Without the parameters that a key offers: names are what a picture is for."""
    path, colon, _ = key.partition(":")
    return path + (":…" if colon else "")
