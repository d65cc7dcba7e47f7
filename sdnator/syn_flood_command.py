"""What `sdnator demo syn-flood` shows: a line a second, then the outcome."""

import json
from pathlib import Path
from typing import Annotated

import typer

from sdnator.errors import BadInput, PipelineError
from sdnator.syn_flood import NOTE, Second, SynFloodOptions, SynFloodResult, run_syn_flood


def syn_flood_command(
    *,
    spoofed: Annotated[bool, typer.Option("--spoofed", help="A new source address for each SYN.")] = False,
    hundred: Annotated[bool, typer.Option("--hundred", help="A hundred source addresses.")] = False,
    unarmed: Annotated[
        bool, typer.Option("--unarmed", help="The firewall has to find the flood itself.")
    ] = False,
    ipv6: Annotated[bool, typer.Option("--ipv6", help="IPv6 instead of IPv4.")] = False,
    switch: Annotated[str, typer.Option(help="embedded or bmv2.")] = "embedded",
    rate: Annotated[int, typer.Option(help="SYNs a second.", min=100, max=20_000)] = 5000,
    seconds: Annotated[
        float, typer.Option(help="Length of the flood with the product.", min=5, max=600)
    ] = 12.0,
    keep: Annotated[
        Path | None, typer.Option(help="Folder to keep logs and reports in.", metavar="DIR")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """A real SYN flood against a real TCP service in network namespaces, without and with the product (root).

    Example: sdnator demo syn-flood --spoofed
    """
    if spoofed and hundred:
        raise BadInput("--spoofed and --hundred exclude each other")
    if switch not in ("embedded", "bmv2"):
        raise BadInput(f"--switch {switch}: give embedded or bmv2")
    options = SynFloodOptions(
        sources="spoofed" if spoofed else "hundred" if hundred else "one",
        version=6 if ipv6 else 4,
        switch=switch,
        armed=not unarmed,
        rate=rate,
        seconds=seconds,
        keep=keep,
    )
    _run(options, as_json=as_json)


def _run(options: SynFloodOptions, *, as_json: bool) -> None:
    if not as_json:
        print(f"{options.sources} source(s), {options.rate:,} SYN/s; {NOTE}")
        print(f"{'':24}{'second':>7}{'tried':>7}{'connected':>11}{'half-open':>11}{'challenged':>12}")
    result = run_syn_flood(options, (lambda _: None) if as_json else _show)
    if as_json:
        print(json.dumps(result.to_json()))
    else:
        _conclude(result)
    if result.void:
        raise PipelineError(result.void)


def _show(line: Second) -> None:
    numbers = f"{line.second:>7}{line.tried:>7}{line.succeeded:>11}{line.half_open:>11}{line.challenged:>12,}"
    print(f"{line.phase:24}{numbers}", flush=True)


def _conclude(result: SynFloodResult) -> None:
    rows = {
        "connections without the product": _share(result.client_success_unprotected),
        "known clients with it": _share(result.known_client_success),
        "new clients with it": _share(result.new_client_success),
        "median connect of new clients": _milliseconds(result.new_connect_ms_p50),
        "half-open at the victim, at most": f"{result.half_open_peak}",
        "first SYN to mitigation": _milliseconds(result.time_to_mitigate_ms),
        "entries in the switch, at most": f"{result.entries_peak}",
        "SYNs sent, challenged": f"{result.sent:,}, {result.challenged:,}",
    }
    for label, value in rows.items():
        print(f"  {label:36}{value}")
    for decision in result.decisions[:5]:
        print(f"  {decision}")
    if len(result.decisions) > 5:
        print(f"  … and {len(result.decisions) - 5} further decisions")


def _share(value: float | None) -> str:
    return "none" if value is None else f"{value:.1%}"


def _milliseconds(value: float | None) -> str:
    return "none" if value is None else f"{value:,.0f} ms"
