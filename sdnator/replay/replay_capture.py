"""A replay for Python programs and notebooks: one call, and the result as numpy arrays."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from apps.messages import Alert
from sdnator import training
from sdnator.datasets.names import NamedCapture, named_capture
from sdnator.errors import BadInput
from sdnator.replay import run
from sdnator.replay.laps import LEAST_REACTION_S, MOST_REACTION_S, REACTION_NS
from sdnator.replay.loop import Progress, ReplayOptions, Telemetry
from sdnator.replay.packet_accounting import PacketAccounting
from sdnator.report.writer import check_folder

Training: TypeAlias = int | tuple[int, int] | None
OnProgress: TypeAlias = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureReplay:
    """The result of `replay_capture`. Arrays have one entry per packet, in the order of the capture."""

    capture: Path
    time_ns: NDArray[np.int64]
    """Capture time, nanoseconds since the epoch (UTC); shape (packets,)."""
    scores: NDArray[np.float64]
    """RMSE of Kitsune's output layer, shape (packets,); 0.0 while training, NaN where a packet was not scored.

    These are the scores of the last pass: the one with blocking, unless `mitigate` was False.
    """
    scores_without_blocking: NDArray[np.float64] | None
    """The same for the pass without blocking; None where there was no such pass."""
    states: NDArray[np.uint8]
    """The state of each packet, as a number of `sdnator.replay.packet_accounting.PacketState`; (packets,)."""
    attack: NDArray[np.bool_] | None
    """True for packets that the labels count to an attack, shape (packets,); None without labels."""
    alerts: tuple[Alert, ...]
    """Kitsune's alerts in the last pass, in the order in which they were raised."""
    blocks: list[dict[str, Any]]
    """One entry per installed block: `address`, `reason`, `time` and `decided` (capture time, seconds since the
    epoch), `packet` (index of the first packet that met the block), `handle` and `id`."""
    figures: dict[str, Any]
    """The object that `sdnator replay --json` prints; docs/replay.md explains each figure."""
    notes: list[str]
    """What to know about the capture, such as time stamps that run backwards."""
    report: Path | None
    """`index.html` of the report; None where no report was asked for."""


def replay_capture(
    capture: str | Path,
    labels: str | Path | None = None,
    *,
    train: Training = None,
    mitigate: bool = True,
    pace: float | None = None,
    telemetry: Telemetry | None = None,
    queries: bool = True,
    reaction: float = REACTION_NS / 1e9,
    reproducible: bool = False,
    report: str | Path | None = None,
    keep: str | Path | None = None,
    progress: OnProgress | None = None,
) -> CaptureReplay:
    """Replay a capture through the embedded switch, the controller, Kitsune, the Sonata adapter and the firewall.

    The pipeline runs in processes of its own, which end before this returns. With labels or a report there are
    two passes, first a dry run and then with blocking, as with `sdnator replay`; without, too, if the dry run saves
    more time than it takes. Call it from the main thread: the processes end with the thread that started them.

    Args:
        capture: a pcap or pcapng file, plain or gzipped; or the name of a fetched data set, such as "mirai".
        labels: a file with one label per packet; None takes those of the data set, if it has any.
        train: number of packets to train on, at least 11; or a pair, packets for the feature map and for the
            autoencoders. None takes what the data set's publication used, otherwise 55,000.
        mitigate: False decides and archives, but blocks nothing.
        pace: capture seconds per wall second; None replays as fast as the pipeline goes.
        telemetry: "packet-in" or "digest", the way headers come from the switch; None takes digests.
        queries: False runs Kitsune alone, without the Sonata adapter and the defence against SYN floods.
        reaction: capture seconds, 0.001 to 60, from the packet that makes a block due until the block is in force.
        reproducible: True drops the same packets in every replay, and takes longer.
        report: folder for the HTML report; None writes none.
        keep: folder for the logs of all parts and the archive; None deletes them.
        progress: called from time to time with the title of the pass, the packets done and the packets in the capture.

    Returns:
        Scores, blocks, figures and the state of each packet.

    Raises:
        BadInput: an argument, the capture or the labels cannot be used; the text says which and what to do.
        PipelineError: a part of the pipeline failed.
    """
    found = named_capture(Path(capture), Path(labels) if labels is not None else None)
    fm_grace, ad_grace = _training(train, found)
    if pace is not None and not 0 < pace < 1e6:
        raise BadInput(f"pace={pace}: give None, or capture seconds per wall second between 0 and 1,000,000")
    if telemetry not in (None, "packet-in", "digest"):
        raise BadInput(f'telemetry={telemetry!r}: give None, "packet-in" or "digest"')
    if not LEAST_REACTION_S <= reaction <= MOST_REACTION_S:
        raise BadInput(
            f"reaction={reaction}: give {LEAST_REACTION_S:g} to {MOST_REACTION_S:g} capture seconds"
        )
    if report is not None:
        check_folder(report)
    options = ReplayOptions(
        fm_grace=fm_grace,
        ad_grace=ad_grace,
        pace=pace,
        telemetry=telemetry,
        queries=queries,
        reaction_ns=round(reaction * 1e9),
        reproducible=reproducible,
        keep=Path(keep) if keep is not None else None,
    )
    surveyed, read = run.prepare(found.capture, found.labels, options)
    both = mitigate and (read is not None or report is not None)
    bars = _bars(progress, surveyed.packets) if progress is not None else None
    outcome = run.run(surveyed, read, options, mitigate=mitigate, both=both, progress=bars)
    return _result(outcome, Path(report) if report is not None else None)


def _training(train: Training, found: NamedCapture) -> tuple[int, int]:
    """Packets for the feature map and for the autoencoders; raises BadInput."""
    if train is None and found.training is not None:
        return found.training.fm_grace, found.training.ad_grace
    if train is None:
        return ReplayOptions.fm_grace, ReplayOptions.ad_grace
    if isinstance(train, int):
        train = training.split(train)
    if min(train) < 1:
        raise BadInput(f"train={train}: give at least 11 packets, or a pair of at least 1 packet each")
    return train


def _bars(progress: OnProgress, packets: int) -> Callable[[str], Progress]:
    def of_pass(title: str) -> Progress:
        def on_progress(flight: PacketAccounting, _blocks: int) -> None:
            progress(title, flight.decided, packets)

        return on_progress

    return of_pass


def _result(outcome: run.ReplayOutcome, report: Path | None) -> CaptureReplay:
    figures = run.figures(outcome)
    page = None
    if report is not None:
        from sdnator.report.replay_report import write_replay_report

        page = write_replay_report(report, outcome, figures)
    last, dry_run = outcome.reported, outcome.dry_run
    return CaptureReplay(
        capture=outcome.survey.path,
        time_ns=outcome.survey.time_ns,
        scores=last.flight.score,
        scores_without_blocking=dry_run.flight.score if dry_run is not None else None,
        states=last.flight.state,
        attack=outcome.labels.attack if outcome.labels is not None else None,
        alerts=tuple(last.alerts),
        blocks=figures["blocks"],
        figures=figures,
        notes=outcome.notes,
        report=page,
    )
