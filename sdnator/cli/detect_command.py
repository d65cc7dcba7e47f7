"""`sdnator detect`: options, progress and output."""

import json
import signal
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

from sdnator.cli.late_progress import LateProgress
from sdnator.plurals import counted


def detect_command(
    capture: Annotated[
        Path | None,
        typer.Argument(
            help="pcap, pcapng or tshark table (19 columns), each plain or gzipped; or a fetched data set's name."
        ),
    ] = None,
    *,
    out: Annotated[Path, typer.Option(help="Folder for scores, plot and summary.", metavar="DIR")],
    interface: Annotated[
        str | None, typer.Option(help="Interface to listen on instead, until Ctrl-C.", metavar="IFACE")
    ] = None,
    labels: Annotated[
        Path | None, typer.Option(help="Labels: index,label,attacker; or lines of 0/1.")
    ] = None,
    model: Annotated[Path | None, typer.Option(help="Score with this trained model.")] = None,
    retrain_from: Annotated[Path | None, typer.Option(help="Continue to train this model.")] = None,
    save_model: Annotated[Path | None, typer.Option(help="File for the trained model.")] = None,
    threshold: Annotated[float, typer.Option(help="Score from which a packet is anomalous.")] = 1.0,
    false_alarms: Annotated[
        float,
        typer.Option(
            help="Set the threshold by benign packets above it per hour, from a fit of benign scores.", min=0
        ),
    ] = 0.0,
    mode: Annotated[
        Literal["reference", "bounded"] | None,
        typer.Option(
            help="reference: as published; bounded: with limited memory (default on an interface).",
            show_default="reference",
        ),
    ] = None,
    fm_grace: Annotated[
        int | None,
        typer.Option(
            help="Packets that train the feature map.", min=1, show_default="5000, or the data set's"
        ),
    ] = None,
    ad_grace: Annotated[
        int | None,
        typer.Option(
            help="Packets that train the autoencoders.", min=1, show_default="50000, or the data set's"
        ),
    ] = None,
    max_ae: Annotated[int, typer.Option(help="Maximum number of features per autoencoder.", min=1)] = 10,
    features: Annotated[Path | None, typer.Option(help="File for all features.", metavar="FILE.npy")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Score every packet of a capture or an interface with Kitsune, without a switch and without blocking.

    Example: sdnator detect mirai.pcap --labels mirai.labels.csv --out scores
    """
    from sdnator.datasets.catalogue import TrainingLength
    from sdnator.datasets.names import named_capture
    from sdnator.detect.run import DetectOptions, detect
    from sdnator.errors import BadInput

    if (capture is None) == (interface is None):
        raise BadInput("give either a capture or --interface")
    console = Console(stderr=True)
    named = named_capture(capture, labels) if capture is not None else None
    if named is not None and named.note:
        console.print(f"note: {named.note}", markup=False, highlight=False, soft_wrap=True)
    training = (named.training if named is not None else None) or TrainingLength(
        fm_grace=5_000, ad_grace=50_000
    )
    options = DetectOptions(
        out=out,
        capture=named.capture if named is not None else None,
        labels=named.labels if named is not None else labels,
        model=model,
        retrain_from=retrain_from,
        save_model=save_model,
        features=features,
        threshold=threshold,
        false_alarms_per_hour=false_alarms,
        mode=mode or ("bounded" if interface else "reference"),
        fm_grace=fm_grace or training.fm_grace,
        ad_grace=ad_grace or training.ad_grace,
        max_ae=max_ae,
    )
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with LateProgress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("")

        def show(packets: int, alerts: int) -> None:
            bar.update(task, description=f"{counted(packets, 'packet')}, {counted(alerts, 'alert')}")

        def tell(line: str) -> None:
            console.print(f"note: {line}", markup=False, highlight=False, soft_wrap=True)

        source = _live(interface, tell) if interface else None
        summary = detect(options, show, source)
    if as_json:
        print(json.dumps(summary))
    else:
        _show(summary, out)


def _live(interface: str, tell: Callable[[str], None]) -> Any:
    """Listen until Ctrl-C or SIGTERM, which end the run with results."""
    from sdnator.capture.live_capture import LiveSource

    stopped: list[int] = []

    def stop(number: int, _frame: FrameType | None) -> None:
        stopped.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    return LiveSource(interface, lambda: bool(stopped), tell)


def _show(summary: dict[str, Any], out: Path) -> None:
    print(
        f"{counted(summary['packets'], 'packet')}: {summary['training_packets']:,} for training, {summary['scored']:,} scored"
    )
    if summary["median"] is not None:
        print(f"scores: median {summary['median']:.3g}, 99 % below {summary['p99']:.3g}")
    print(f"at or above the threshold {summary['threshold']:.3g}: {counted(summary['over'], 'packet')}")
    print(f"alerts: {summary['alerts']:,} for {', '.join(summary['alerted_senders'][:8]) or 'none'}")
    if summary.get("auc") is not None:
        print(
            f"AUC {summary['auc']:.4f}, TPR {summary['tpr_at_fpr_0']:.3f} at FPR 0 and "
            f"{summary['tpr_at_fpr_0.001']:.3f} at FPR 0.001, equal error rate {summary['equal_error_rate']:.4f}"
        )
    if "model_age_s" in summary:
        drift = summary["benign_drift"]
        shown = "unknown" if drift is None else f"{drift:+.2f} spreads"
        print(
            f"model: trained {summary['model_age_s'] / 86_400:.1f} days before this capture, "
            f"benign scores have moved by {shown}"
        )
    for warning in summary["warnings"]:
        print(f"note: {warning}")
    print(f"written to {out}")
