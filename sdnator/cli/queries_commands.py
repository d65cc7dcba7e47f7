"""`sdnator queries …`: list and explain queries, add your own, run them over captures.

Options are here; the work is done by the Sonata adapter, used as a library.
"""

import json
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from apps.sonata_adapter.errors import SonataError
from apps.sonata_adapter.keys import (
    CAPTURE_PREFIX,
    HANDSHAKE,
    PROTOCOLS,
    QueryRequest,
    capture_parameters,
    request_of,
)
from apps.sonata_adapter.planner.explain import explain as explain_plan
from apps.sonata_adapter.planner.operators import placed_operators
from apps.sonata_adapter.planner.plan import plan
from apps.sonata_adapter.planner.refinement import coarsest
from apps.sonata_adapter.query.catalogue import Template
from apps.sonata_adapter.query.templates import QueryFolder, own_queries, read_text
from apps.sonata_adapter.query.text import parse_queries
from due import DueError
from sdnator.capture.captures import CaptureError
from sdnator.cli.due_commands import Updates
from sdnator.cli.plain_table import plain_table
from sdnator.cli.plan_question import ask_plan
from sdnator.cli.queries_run import Past, as_line, as_text, engine_of, over_archive, over_captures
from sdnator.cli.queries_spark import SparkRun, on_spark_over_archive
from sdnator.cli.queries_workbench import fields_text, fields_value, tested, tested_text, tested_value
from sdnator.errors import BadInput
from sdnator.notation import period_ns
from sdnator.up import running

queries = typer.Typer(
    help="Telemetry queries: list, explain, add your own, run over captures or the archive.",
    no_args_is_help=True,
)

KeyArgument = Annotated[
    str, typer.Argument(help="network.traffic_query.sonata.NAME:window=3s,…", metavar="KEY")
]


def templates() -> dict[str, Template]:
    """The catalogue and the user's own queries."""
    return QueryFolder(own_queries()).templates()


@queries.command("list")
def list_queries(
    *, as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False
) -> None:
    """List all queries and raw streams, one per line; `queries show NAME` shows details.

    Example: sdnator queries list
    """
    rows = [_description(template) for template in templates().values()]
    if as_json:
        typer.echo(json.dumps({"queries": rows, "streams": _streams()}))
        return
    lines = [(row["name"], "switch" if row["in_switch"] else "host", row["meaning"]) for row in rows]
    typer.echo(plain_table(("query", "runs", "meaning"), lines) + "\n")
    # apart, because their names are long
    streams = [(name, stream["meaning"]) for name, stream in _streams().items()]
    typer.echo(plain_table(("raw stream (host)", "meaning"), streams))


@queries.command("show")
def show_query(
    name: Annotated[str, typer.Argument(help="Name of a query, as shown by `queries list`.")],
    *,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Show one query: its text, parameters with defaults and bounds, results and cost.

    Example: sdnator queries show syn_flood
    """
    known = templates()
    stream = _streams().get(name if name.startswith("network.") else f"{CAPTURE_PREFIX}.{name}")
    if name not in known and stream is not None:
        lines = [f"  {spec}: {meaning}" for spec, meaning in stream["meanings"].items()]
        typer.echo(json.dumps(stream) if as_json else "\n".join([stream["meaning"], *lines]))
        return
    if name not in known:
        raise BadInput(f"there is no query {name}; there are {', '.join(known)}")
    row = _description(known[name])
    if as_json:
        typer.echo(json.dumps(row))
        return
    names = ("parameter", "default", "bounds", "meaning")
    table = plain_table(
        names, ([p[part] for part in ("name", "default", "bounds", "meaning")] for p in row["parameters"])
    )
    parts = [f"{row['name']}: {row['meaning']}", row["text"], table]
    parts += [f"results: {row['result']}", f"runs: {row['cost']}", f"key: {row['key']}"]
    typer.echo("\n\n".join(parts))


@queries.command("fields")
def list_fields(
    *, as_json: Annotated[bool, typer.Option("--json", help="One JSON array on standard output.")] = False
) -> None:
    """List the fields that a query can use: type, unit, and what the switch can do with each.

    Example: sdnator queries fields
    """
    typer.echo(json.dumps(fields_value()) if as_json else fields_text())


@queries.command("test")
def try_queries(
    file: Annotated[Path, typer.Argument(help="Text file with queries; they are not added.", metavar="FILE")],
    *,
    capture: Annotated[
        list[Path], typer.Option(help="pcap or pcapng; several are read one after the other.")
    ],
    most: Annotated[
        int, typer.Option(help="Maximum number of results to show per query.", min=0, max=100_000)
    ] = 100,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON line per query.")] = False,
) -> None:
    """Try the queries of a file over a capture: plan, rows of each operator, cost, results.

    Example: sdnator queries test my_scan.sonata --capture day.pcap
    """
    for one in tested(file, capture, most):
        typer.echo(json.dumps(tested_value(one)) if as_json else tested_text(one) + "\n")


@queries.command("explain")
def explain_query(
    key: KeyArgument,
    *,
    updates: Updates = "",
    empty: Annotated[
        bool,
        typer.Option(
            "--empty", help="Plan for a switch without other queries, even if a pipeline is running."
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Show which operators of a query run in the switch and which on the host.

    Asks the running adapter, which knows what else is in its switches; without one, plans for an empty switch.

    Example: sdnator queries explain network.traffic_query.sonata.ddos:window=1s
    """
    known = templates()
    request = _request(key, known)
    found = None if updates or empty else running.find()
    url = "" if empty else updates or (found.updates if found is not None else "")
    if url:
        (told,) = ask_plan(request.key, url)
        if told["state"] == "refused":
            raise BadInput(f"refused: {told['reason']}")
        source = _SOURCES[told["state"]].format(others=told["others"])
        shown = {"source": source, **told}
    else:
        shown = _planned_alone(request, known)
    typer.echo(json.dumps(shown) if as_json else f"{shown['text']}\n\n  {shown['source']}")


_SOURCES = {
    "running": "as it runs now, beside {others} other queries",
    "possible": "as the running adapter would place it now, beside {others} other queries; nobody wants it",
}


def _planned_alone(request: QueryRequest, known: dict[str, Template]) -> dict[str, Any]:
    first = coarsest(request)
    plans = plan([first])
    one = plans.of(first.identity)
    meaning = known[request.name].meaning if request.kind == "query" else ""
    return {
        "source": "as it would be in a switch without other queries; no running adapter was asked",
        "state": "alone",
        "identity": request.identity,
        "in_switch": one.in_switch,
        "reason": one.reason,
        "operators": [msgspec.to_builtins(each) for each in placed_operators(first, one)],
        "text": explain_plan(request, plans, meaning=meaning),
    }


@queries.command("add")
def add_queries(
    file: Annotated[Path, typer.Argument(help="Text file with queries.", metavar="FILE")],
    *,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Add your own queries, replacing those of the same name.  A running adapter loads them.

    Example: sdnator queries add my_scan.sonata
    """
    folder = QueryFolder(own_queries())
    try:
        text = read_text(file, str(file))
        found = parse_queries(text, str(file))
    except OSError as error:
        raise BadInput(f"{file}: cannot be read ({error.strerror}); give a text file with queries") from None
    except SonataError as error:
        raise BadInput(str(error)) from None
    try:
        folder.add(found, text)
    except OSError as error:
        raise BadInput(
            f"{folder.path}: cannot be written ({error.strerror}); check its permissions"
        ) from None
    except SonataError as error:
        raise BadInput(str(error)) from None
    if as_json:
        typer.echo(json.dumps({"added": [template.name for template in found], "folder": str(folder.path)}))
        return
    for template in found:
        typer.echo(f"{template.name}: network.traffic_query.sonata.{template.name}")


@queries.command("run")
def run_query(
    key: KeyArgument,
    *,
    capture: Annotated[
        list[Path] | None, typer.Option(help="pcap or pcapng; several are read one after the other.")
    ] = None,
    since: Annotated[
        str,
        typer.Option(
            help="Use packets archived since then instead: 1h or 7d ago, or a local time such as 2024-05-01T12:00."
        ),
    ] = "",
    until: Annotated[str, typer.Option(help="End, like --since.", show_default="now")] = "",
    archive: Annotated[
        str,
        typer.Option(
            help="Data Archives URL, for --since; default: those of the pipeline.", envvar="DUE_ARCHIVE"
        ),
    ] = "",
    engine: Annotated[
        str, typer.Option(help="Engine of the operators: numpy, or spark (extra `spark`).")
    ] = "numpy",
    master: Annotated[
        str, typer.Option(help="Where Spark runs: local[N] or spark://HOST:PORT.")
    ] = "local[2]",
    spark_option: Annotated[
        list[str] | None,
        typer.Option(help="Further option of Spark, such as spark.executor.memory=4g.", metavar="NAME=VALUE"),
    ] = None,
    parquet: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the packets that Spark reads; hours that it holds whole are not exported again.",
            metavar="DIR",
            show_default="a temporary one",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON line per result.")] = False,
) -> None:
    """Run a query over captures or the archive; results are the same as live.

    With --engine spark, archived packets are first exported to Parquet, as by `sdnator archive export`.

    Example: sdnator queries run network.traffic_query.sonata.new_tcp:threshold=20 --capture day.pcap
    """
    request = _request(key, templates())
    if request.kind == "handshake":
        raise BadInput(f"{HANDSHAKE} is followed live only; run a query or a raw stream")
    if bool(capture) == bool(since) or (until and not since):
        raise BadInput("give either --capture FILE or --since 1h, and --until only with --since")
    on_spark = engine == "spark" and bool(since)
    if (parquet or spark_option) and not on_spark:
        raise BadInput("--parquet and --spark-option: only with --since and --engine spark")
    try:
        if capture:
            found = over_captures(request, capture, engine_of(engine, master))
        else:
            past = Past(running.archive_url(archive), *period_ns(since, until))
            if on_spark:
                found = on_spark_over_archive(request, past, SparkRun(master, spark_option or [], parquet))
            else:
                found = over_archive(request, past, engine_of(engine, master))
        for output in found.outputs:
            typer.echo(json.dumps(as_line(output)) if as_json else as_text(output))
    except (CaptureError, DueError, SonataError) as error:
        raise BadInput(str(error)) from None
    for note in filter(None, found.notes()):
        typer.echo(f"sdnator: {note}", err=True)


def _request(key: str, known: dict[str, Template]) -> QueryRequest:
    try:
        request = request_of(key if "." in key else f"network.traffic_query.sonata.{key}", known)
    except (SonataError, DueError) as error:
        raise BadInput(str(error)) from None
    if request is None:
        raise BadInput(f"{key}: a wildcard only follows queries that others ask for; name one query")
    return request


def _description(template: Template) -> dict[str, Any]:
    request = _request(template.name, {template.name: template})
    found = plan([request]).of(request.identity)
    return {
        "name": template.name,
        "key": request.identity,
        "meaning": template.meaning,
        "result": template.result,
        "text": request.query.text(),
        "in_switch": found.in_switch,
        "parameters": [
            {"name": p.name, "default": p.text(p.default), "bounds": p.bounds, "meaning": p.meaning}
            for p in template.parameters
        ],
        "cost": "in the switch, results only"
        if found.in_switch
        else f"on the host, about {found.tuples_per_second:,.0f} of 10,000 packets are copied",
    }


def _streams() -> dict[str, Any]:
    streams: dict[str, Any] = {
        f"{CAPTURE_PREFIX}.{name}": {
            "meaning": f"{protocol.meaning}, as packets",
            "parameters": sorted(capture_parameters(protocol)),
            "meanings": capture_parameters(protocol),
        }
        for name, protocol in PROTOCOLS.items()
    }
    streams[HANDSHAKE] = {"meaning": "completed TCP handshakes", "parameters": [], "meanings": {}}
    return streams
