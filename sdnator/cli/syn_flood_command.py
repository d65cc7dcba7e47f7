"""Output of `sdnator demo syn-flood`: a line per second, then the outcome."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from sdnator.config.planned_switches import require_compiler
from sdnator.demos.syn_flood.demo import Second, SynFloodOptions, SynFloodResult, Told, note, run_syn_flood
from sdnator.demos.syn_flood.report import Panel, panel, write_report
from sdnator.demos.syn_flood.trial import TrialHosts, TrialOutcome
from sdnator.errors import BadInput, PipelineError

_SOURCES = {
    "one": "one source",
    "hundred": "a hundred sources",
    "spoofed": "a new source for each SYN",
}


def syn_flood_command(
    *,
    spoofed: Annotated[
        bool, typer.Option("--spoofed", help="Use a new source address for each SYN.")
    ] = False,
    hundred: Annotated[bool, typer.Option("--hundred", help="Use a hundred source addresses.")] = False,
    unarmed: Annotated[
        bool,
        typer.Option(
            "--unarmed", help="Do not guard the service beforehand: the firewall has to detect the flood."
        ),
    ] = False,
    ipv6: Annotated[bool, typer.Option("--ipv6", help="Use IPv6 instead of IPv4.")] = False,
    switch: Annotated[str, typer.Option(help="embedded or bmv2.")] = "embedded",
    rate: Annotated[int, typer.Option(help="SYNs per second.", min=100, max=20_000)] = 5000,
    seconds: Annotated[
        float, typer.Option(help="Seconds of the flood with the product.", min=5, max=600)
    ] = 12.0,
    keep: Annotated[
        Path | None, typer.Option(help="Folder to keep logs and reports in.", metavar="DIR")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Folder for a picture and the figures.", metavar="DIR")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Send a real SYN flood to a TCP service, without and with the product (root).

    Example: sdnator demo syn-flood --spoofed
    """
    if spoofed and hundred:
        raise BadInput("--spoofed and --hundred cannot be combined; give one of them")
    if switch not in ("embedded", "bmv2"):
        raise BadInput(f"--switch {switch}: give embedded or bmv2")
    if switch == "embedded":
        require_compiler()
    options = SynFloodOptions(
        sources="spoofed" if spoofed else "hundred" if hundred else "one",
        version=6 if ipv6 else 4,
        switch=switch,
        armed=not unarmed,
        rate=rate,
        seconds=seconds,
        keep=keep,
    )
    _run(options, report, as_json=as_json)


def _run(options: SynFloodOptions, report: Path | None, *, as_json: bool) -> None:
    panels: list[Panel] = []

    def ended(field: TrialHosts, outcomes: list[TrialOutcome]) -> None:
        titles = ("without the product", "with the product")
        if report is not None:
            confirmed = field.stage.confirmed
            panels.extend(
                panel(title, outcome, field.records, confirmed)
                for title, outcome in zip(titles, outcomes, strict=False)
            )

    told = Told(ended=ended) if as_json else Told(_begin(options), _show, ended)
    result = run_syn_flood(options, told)
    picture = None if report is None else write_report(report, result.to_json(), panels)
    if as_json:
        print(json.dumps(result.to_json()))
    else:
        _conclude(result)
        if picture is not None:
            print(f"\nthe picture is {picture}")
    if result.void:
        raise PipelineError(result.void)


def _begin(options: SynFloodOptions) -> Callable[[dict[str, int]], None]:
    def begin(kernel: dict[str, int]) -> None:
        what = f"{_SOURCES[options.sources]}, {options.rate:,} SYN/s, IPv{options.version}"
        print(f"{what}, {options.switch} switch\n{note(kernel)}\n")
        print(f"{'':20}{'second':>7}{'tried':>7}{'connected':>11}{'half-open':>11}{'challenged':>12}  rule")

    return begin


def _show(line: Second) -> None:
    numbers = f"{line.second:>7}{line.tried:>7}{line.succeeded:>11}{line.half_open:>11}{line.challenged:>12,}"
    print(f"{line.phase:20}{numbers}  {line.rule}".rstrip(), flush=True)


def _conclude(result: SynFloodResult) -> None:
    rows = {
        "clients without the product": _share(result.client_success_unprotected),
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
