"""`sdnator queries …`: what can be asked, what it would cost, own queries, and queries over captures.

Options here; the work is the Sonata adapter's, which the commands use as a library.
"""

import json
import time
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from apps.packets import read_frames
from apps.sonata_adapter.catalogue import Template
from apps.sonata_adapter.engine import HostEngine
from apps.sonata_adapter.errors import SonataError
from apps.sonata_adapter.explain import explain as explain_plan
from apps.sonata_adapter.keys import (
    CAPTURE_PREFIX,
    HANDSHAKE,
    PROTOCOLS,
    Request,
    capture_parameters,
    request_of,
)
from apps.sonata_adapter.planner import plan
from apps.sonata_adapter.results import Captured, Result
from apps.sonata_adapter.templates import QueryFolder, own_queries
from apps.sonata_adapter.text import parse_queries
from due import DueError, RecordBatch
from due.backends import open_archive
from sdnator.captures import Capture, CaptureError
from sdnator.errors import BadInput

queries = typer.Typer(
    help="Telemetry queries: list, explain, add your own, run over the past.", no_args_is_help=True
)
_WIDTH = 256
_BATCH = 16_384
_UNITS_NS = {"s": 10**9, "m": 60 * 10**9, "h": 3_600 * 10**9, "d": 86_400 * 10**9}
_PACKETS = "network.packets.p4runtime_ctrl.*.all"

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
    """All queries with meaning, parameters (default, bounds) and where they run.

    Example: sdnator queries list
    """
    rows = [_description(template) for template in templates().values()]
    if as_json:
        typer.echo(json.dumps({"queries": rows, "streams": _streams()}))
        return
    out = Console(highlight=False)
    for row in rows:
        out.print(f"[bold]{row['name']}[/]  {row['meaning']}")
        table = Table(show_header=False, box=None, padding=(0, 2, 0, 4))
        for each in row["parameters"]:
            table.add_row(each["name"], each["default"], each["bounds"], each["meaning"])
        out.print(table)
        out.print(f"    results: {row['result']}")
        out.print(f"    runs: {row['cost']}\n")
    for name, stream in _streams().items():
        out.print(f"[bold]{name}[/]  {stream['meaning']}")
        out.print(f"    {', '.join(stream['parameters'])}\n" if stream["parameters"] else "")


@queries.command("explain")
def explain_query(key: KeyArgument) -> None:
    """What a key puts into the switch, and what stays on the host.

    Example: sdnator queries explain network.traffic_query.sonata.ddos:window=1s
    """
    known = templates()
    request = _request(key, known)
    meaning = known[request.name].meaning if request.kind == "query" else ""
    typer.echo(explain_plan(request, plan([request]), meaning=meaning))


@queries.command("add")
def add_queries(
    file: Annotated[Path, typer.Argument(help="Queries in text form.", metavar="FILE")],
    *,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Register queries of your own; a query of the same name is replaced.  A running adapter takes them up.

    Example: sdnator queries add my_scan.sonata
    """
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeError) as error:
        raise BadInput(f"{file}: cannot be read ({error}); give a text file with queries") from None
    try:
        found = parse_queries(text, str(file))
        folder = QueryFolder(own_queries())
        folder.add(found, text)
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
    since: Annotated[str, typer.Option(help="Over archived packets instead: 30s, 10m, 1h, 7d.")] = "",
    archive: Annotated[str, typer.Option(help="Data Archives URL, for --since.", envvar="DUE_ARCHIVE")] = "",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON line for each result.")] = False,
) -> None:
    """Run a query over captures or over the archive: the results are those of a live run.

    Example: sdnator queries run network.traffic_query.sonata.new_tcp:threshold=20 --capture day.pcap
    """
    request = _request(key, templates())
    if request.kind == "handshake":
        raise BadInput(f"{HANDSHAKE} is followed live only; run a query or a raw stream")
    if bool(capture) == bool(since):
        raise BadInput("give either --capture FILE or --since 1h")
    try:
        batches = _captured(capture) if capture else _archived(archive, since)
        for output in _run(request, batches):
            typer.echo(json.dumps(_line(output)) if as_json else _text(output))
    except (CaptureError, DueError) as error:
        raise BadInput(str(error)) from None


def _request(key: str, known: dict[str, Template]) -> Request:
    try:
        request = request_of(key if "." in key else f"network.traffic_query.sonata.{key}", known)
    except (SonataError, DueError) as error:
        raise BadInput(str(error)) from None
    if request is None:
        raise BadInput(f"{key}: a wildcard follows what others ask for; name one query")
    return request


def _description(template: Template) -> dict[str, Any]:
    request = _request(template.name, {template.name: template})
    found = plan([request]).of(request.identity)
    return {
        "name": template.name,
        "key": request.identity,
        "meaning": template.meaning,
        "result": template.result,
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
        }
        for name, protocol in PROTOCOLS.items()
    }
    streams[HANDSHAKE] = {"meaning": "completed TCP handshakes", "parameters": []}
    return streams


def _run(request: Request, batches: Iterable[tuple[int, RecordBatch]]) -> Iterator[Result | Captured]:
    engine: HostEngine | None = None
    for base_us, batch in batches:
        if engine is None:
            engine = HostEngine(base_us=base_us)
            engine.add(request.query)
        yield from engine.process(batch)
    if engine is not None:
        yield from engine.finish()


def _captured(paths: list[Path]) -> Iterator[tuple[int, RecordBatch]]:
    """Windows count from the second of the first packet, as in a replay."""
    base_us, number = None, 0
    for path in paths:
        with Capture(path) as capture:
            if base_us is None:
                base_us = capture.first_time_ns // 10**9 * 10**6
            frames = iter(capture)
            while part := list(islice(frames, _BATCH)):
                yield (
                    base_us,
                    _batch([f[0] // 1000 for f in part], [f[1] for f in part], [f[2] for f in part], number),
                )
                number += len(part)


def _batch(times_us: list[int], lengths: list[int], frames: list[bytes], first: int) -> RecordBatch:
    cut = [frame[:_WIDTH] for frame in frames]
    numbers = np.arange(first, first + len(frames))
    batch = read_frames(
        cut,
        lengths=lengths,
        times_us=times_us,
        ports=np.ones(len(frames), dtype=np.uint16),
        sequence=numbers + 1,
        arrival=numbers,
    )
    captured = np.array([len(frame) for frame in cut], dtype=np.uint16)
    return RecordBatch({**batch, "frame": np.array(cut, dtype=f"V{_WIDTH}"), "captured": captured})


def _archived(url: str, since: str) -> Iterator[tuple[int, RecordBatch]]:
    if not url:
        raise BadInput("--since needs --archive URL (or DUE_ARCHIVE), such as sqlite:///path/archive.db")
    if since[-1:] not in _UNITS_NS or not since[:-1].isdecimal():
        raise BadInput(f"--since {since}: write 30s, 10m, 1h or 7d")
    begin = time.time_ns() - int(since[:-1]) * _UNITS_NS[since[-1]]
    archive = open_archive(url)
    try:
        for item in archive.find({"dataKey": _PACKETS, "timestamp": {"$gte": begin}}):
            yield 0, item.value
    finally:
        archive.close()


def _line(output: Result | Captured) -> dict[str, Any]:
    if isinstance(output, Captured):
        return {"packets": len(output.batch), "until": output.last_us * 1000}
    return {"query": output.query, **output.to_value()}


def _text(output: Result | Captured) -> str:
    if isinstance(output, Captured):
        return f"{len(output.batch):,} packets until {_clock(output.last_us)}"
    fields = "  ".join(f"{name} {value}" for name, value in sorted(output.fields.items()))
    mark = "" if output.exact else f"  (estimate: {output.error})"
    return f"{_clock(output.at_us)}  {fields}{mark}"


def _clock(time_us: int) -> str:
    second, fraction = divmod(time_us, 10**6)
    return f"{time.strftime('%Y-%m-%d %H:%M:%S', time.gmtime(second))}.{fraction:06d}"
