"""Output of `sdnator replay` and `sdnator demo`: progress, summary, JSON, report."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, get_args

from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from dataplane.p4runtime.listening import is_address
from sdnator import training
from sdnator.cli.late_progress import LateProgress
from sdnator.config.planned_switches import require_compiler
from sdnator.datasets.names import named_capture
from sdnator.errors import BadInput
from sdnator.plurals import counted
from sdnator.replay import run as replay_run
from sdnator.replay.laps import LEAST_REACTION_S, MOST_REACTION_S
from sdnator.replay.loop import REPRODUCIBLE_WINDOW, ReplayOptions, Telemetry
from sdnator.replay.packet_accounting import PacketAccounting
from sdnator.report.writer import check_folder

if TYPE_CHECKING:
    from p4rt import ChannelSecurity

DEFAULT_TRAIN = 55_000
"""Packets to train on: the published 5,000 + 50,000."""

console = Console(stderr=True, highlight=False)


@dataclass(frozen=True, kw_only=True)
class ReplayRequest:
    """The options of `sdnator replay`, as typed."""

    capture: Path
    labels: Path | None
    switch: str
    inject: str | None
    mitigate: bool
    train: int | None
    """None = the data set's published length, or 55,000."""
    fm_grace: int | None
    ad_grace: int | None
    pace: str
    window: int | None = None
    reaction: float = 0.5
    reproducible: bool = False
    telemetry: str | None = None
    queries: bool = True
    model: Path | None = None
    report: Path | None
    keep: Path | None
    as_json: bool
    insecure: bool = False


def options_of(request: ReplayRequest) -> ReplayOptions:
    """Check the options; raises BadInput that names the wrong one."""
    if (request.fm_grace is None) != (request.ad_grace is None):
        raise BadInput("--fm-grace and --ad-grace go together: give both, or --train N")
    check_switch(request.switch, request.inject)
    if request.model is not None:
        _check_model(request)
    fm_grace, ad_grace = training.split(request.train or DEFAULT_TRAIN)
    if request.fm_grace is not None and request.ad_grace is not None:
        fm_grace, ad_grace = request.fm_grace, request.ad_grace
    return ReplayOptions(
        switch=request.switch,
        security=_security(request),
        inject=request.inject,
        fm_grace=fm_grace,
        ad_grace=ad_grace,
        pace=_pace(request.pace),
        window=request.window,
        reaction_ns=_reaction(request),
        reproducible=request.reproducible,
        telemetry=_telemetry(request.telemetry),
        queries=request.queries,
        model=request.model,
        keep=request.keep,
    )


def _reaction(request: ReplayRequest) -> int:
    """The reaction time, ns; raises BadInput."""
    if not LEAST_REACTION_S <= request.reaction <= MOST_REACTION_S:
        raise BadInput(
            f"--reaction {request.reaction:g}: give {LEAST_REACTION_S:g} to {MOST_REACTION_S:g} capture seconds"
        )
    if request.reproducible and request.window is not None and request.window < REPRODUCIBLE_WINDOW:
        raise BadInput(
            f"--window {request.window}: with --reproducible give at least {REPRODUCIBLE_WINDOW}, or leave it out"
        )
    return round(request.reaction * 1e9)


def _check_model(request: ReplayRequest) -> None:
    """Refuse a model that cannot be loaded before anything starts; raises BadInput."""
    from apps.kitsune.model_file import ModelFileError, load_model

    assert request.model is not None  # noqa: S101 - asked by the caller
    if request.train is not None or request.fm_grace is not None:
        raise BadInput("--model: nothing is trained with it; leave out --train, --fm-grace and --ad-grace")
    try:
        load_model(request.model)
    except ModelFileError as error:
        raise BadInput(f"--model {error}") from None


def check_switch(switch: str, inject: str | None) -> None:
    """Refuse a switch that cannot be used; raises BadInput."""
    if switch == "embedded":
        require_compiler()
        return
    if switch == "bmv2":
        if shutil.which("simple_switch_grpc") is None:
            raise BadInput(
                "--switch bmv2: simple_switch_grpc is not installed; install BMv2, or use --switch embedded"
            )
        if os.geteuid() != 0:
            raise BadInput("--switch bmv2: veth pairs need root; run as root, or use --switch embedded")
        return
    if not is_address(switch):
        raise BadInput(f"--switch {switch}: give embedded, bmv2, HOST:PORT or unix:/PATH")
    if inject is None:
        raise BadInput(f"--switch {switch}: add --inject IFACE, the interface through which frames enter it")


def _security(request: ReplayRequest) -> "ChannelSecurity | None":
    """How the channel to an external switch is secured.  Raises BadInput."""
    if not is_address(request.switch):
        return None
    from sdnator.config.switch_security import security_for

    return security_for(request.switch, insecure=request.insecure)


def _telemetry(text: str | None) -> Telemetry | None:
    if text is None:
        return None
    if text not in get_args(Telemetry):
        raise BadInput(f"--telemetry {text}: give {' or '.join(get_args(Telemetry))}")
    return cast("Telemetry", text)


def _pace(text: str) -> float | None:
    if text == "max":
        return None
    try:
        pace = float(text.removesuffix("x"))
    except ValueError:
        pace = 0.0
    if not 0 < pace < 1e6:
        raise BadInput(f"--pace {text}: give max, or a multiple of real time such as 1x or 10x")
    return pace


@contextmanager
def _bars() -> Iterator[Progress]:
    with LateProgress(
        TextColumn("{task.description:<14}"),
        BarColumn(),
        TextColumn("{task.completed:>9,.0f}/{task.total:,.0f}"),
        TextColumn("{task.fields[detail]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=False,
    ) as bars:
        yield bars


def run_replay(request: ReplayRequest) -> None:
    """`sdnator replay`; raises SdnatorError."""
    options_of(request)  # report wrong options before looking for the data set
    request = _with_data_set(request)
    options = options_of(request)
    if request.report is not None:
        check_folder(request.report)
    with _bars() as bars:
        reading = bars.add_task("reading", total=1, detail="bytes")

        def on_read(position: int, size: int) -> None:
            bars.update(reading, completed=position, total=size)

        surveyed, labels = replay_run.prepare(request.capture, request.labels, options, on_read)
        bars.update(reading, completed=surveyed.packets, total=surveyed.packets, detail="packets")
        for note in surveyed.notes():
            console.print(f"[yellow]note:[/] {note}")
        outcome = replay_run.run(
            surveyed,
            labels,
            options,
            mitigate=request.mitigate,
            both=request.mitigate and (labels is not None or request.report is not None),
            progress=lambda title: _on_progress(bars, title, surveyed.packets),
        )
    found = replay_run.figures(outcome)
    if request.report is not None:
        from sdnator.report.replay_report import write_replay_report

        found["report"] = str(write_replay_report(request.report, outcome, found))
    if request.as_json:
        print(json.dumps(found))
    else:
        show(found)


def _with_data_set(request: ReplayRequest) -> ReplayRequest:
    """The request with capture, labels and training length of the data set that it names."""
    found = named_capture(request.capture, request.labels)
    if found.note:
        console.print(f"[yellow]note:[/] {escape(found.note)}", soft_wrap=True)
    request = replace(request, capture=found.capture, labels=found.labels)
    if (
        found.training is None
        or request.model is not None
        or request.train is not None
        or request.fm_grace is not None
    ):
        return request
    return replace(request, fm_grace=found.training.fm_grace, ad_grace=found.training.ad_grace)


def _on_progress(bars: Progress, title: str, packets: int) -> Callable[[PacketAccounting, int], None]:
    task = bars.add_task(title, total=packets, detail="")

    def update(flight: PacketAccounting, blocks: int) -> None:
        elapsed = bars.tasks[task].elapsed or 0.0
        rate = flight.decided / elapsed if elapsed > 0 else 0.0
        bars.update(task, completed=flight.decided, detail=f"{rate:,.0f}/s, {counted(blocks, 'block')}")

    return update


def show(found: dict[str, Any]) -> None:
    """Print the summary as text."""
    out = Console(highlight=False)
    table = Table(show_header=False, box=None, padding=(0, 2))
    for label, value in _rows(found):
        table.add_row(label, value)
    out.print(table)
    for block in found["blocks"]:
        out.print(
            f"[bold red]blocked[/] {block['address']} at packet {block['packet']:,} ({escape(block['handle'])})"
        )
        out.print(_indented(block["reason"]))
    for guard in found["guards"]:
        out.print(
            f"[bold yellow]would guard[/] {guard['address']}:{guard['port']} from packet {guard['packet']:,} on"
        )
        out.print(_indented(guard["reason"]))
    for limit in found["limits"]:
        words = "would limit" if limit["effect"] == "would limit" else "limited"
        dropped = limit["packets_dropped"] or limit["packets_would_be_dropped"]
        out.print(
            f"[bold yellow]{words}[/] {escape(limit['packets'])} towards {limit['address']} to {limit['rate']:,}/s "
            f"from packet {limit['packet']:,} on: {dropped:,} over it"
        )
        out.print(_indented(limit["reason"]))
    if "report" in found:
        out.print(f"report: {found['report']}")


def _indented(reason: str) -> Padding:
    return Padding(escape(reason), (0, 0, 0, 8), expand=False)


def _rows(found: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield (
        "packets in",
        f"{found['packets_in']:,} in {found['seconds']:.1f} s ({found['packets_per_second']:,.0f}/s)",
    )
    yield "scored", f"{found['packets_scored']:,}, {found['training_packets']:,} of them for training"
    yield "dropped", f"{found['packets_dropped']:,}"
    if found["blocks"]:
        yield (
            "passed in flight",
            f"{found['passed_in_flight']:,} of blocked senders, before their block took effect",
        )
    yield "not copied", f"{found['packets_not_copied']:,}"
    if found["packets_limited"]:
        yield "of these over limits", f"{found['packets_limited']:,}"
    if found["packets_would_be_limited"]:
        yield "would limit", f"{found['packets_would_be_limited']:,} packets, which passed"
    if found["guards"]:
        yield "would challenge", f"{found['packets_would_be_challenged']:,} SYNs, which passed"
    yield "lost", f"{found['packets_lost']:,}"
    yield "alerts", f"{found['alerts']:,}"
    yield "incidents", f"{len(found['incidents']):,}, {found['incidents_mitigated']:,} mitigated within 5 s"
    if found.get("time_to_block_s") and found["time_to_block_s"]["capture"] is not None:
        yield (
            "time to block",
            f"{found['time_to_block_s']['capture']:.1f} s of capture time after the first attack packet",
        )
    if "attack_dropped" in found:
        if found["blocks"]:
            after = f"{found['attack_after_first_block']:,} attack packets after the first block"
        else:
            after = f"{found['attack_packets']:,} attack packets"
        yield "attack stopped", f"{found['attack_dropped']:,} of {after}"
        yield "benign dropped", f"{found['benign_dropped']:,}"
        if found["benign_limited"]:
            yield "benign over limits", f"{found['benign_limited']:,}"
        yield "collateral", f"{found['collateral_dropped']:,} benign packets of attacking devices"
    if found["auc"] is not None:
        yield "ROC AUC", f"{found['auc']:.4f} (Kitsune alone)"


def run_demo(folder: Path, seed: int, *, as_json: bool) -> None:
    """`sdnator demo`: a generated capture, replayed with a report; a second run reuses the capture."""
    from sdnator.capture.labels import labels_path
    from sdnator.datasets.mirai_like import make_mirai_like

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"--folder {folder}: {error.strerror}; give another folder") from error
    capture = folder / f"mirai-like-{seed}.pcap"
    labels = labels_path(capture)
    if not (capture.exists() and labels.exists()):
        console.print(f"making {capture}: 50 minutes of a home network, then an infected camera")
        make_mirai_like(capture, seed=seed)
    run_replay(
        ReplayRequest(
            capture=capture,
            labels=labels,
            switch="embedded",
            inject=None,
            mitigate=True,
            train=55_000,
            fm_grace=None,
            ad_grace=None,
            pace="max",
            window=None,
            report=folder / "report",
            keep=None,
            as_json=as_json,
        )
    )
