"""The report of a replay: a page for people, and files for programs.

    index.html      self-contained: verdict, figures, the picture, blocks and why
    scores.png      the picture alone
    scores.csv      index,time,score,state      (state: train, scored, dropped, not copied, lost)
    decisions.csv   what the firewall decided and what the switch did
    eve.json        incidents, decisions by hand and drops in Suricata's EVE format, one JSON object a line

It is written to a temporary folder beside its place and renamed when it is complete.

    ReportError (BadInput)      the folder cannot be written, or holds something else
"""

import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.incidents import Incident
from apps.messages import Confirmation, Decision
from sdnator.errors import BadInput
from sdnator.incidents.incident_rows import row
from sdnator.report import report_files, report_page
from sdnator.report.plots import Curve, draw

FILES: Final = ("index.html", "scores.png", "scores.csv", "decisions.csv", "eve.json")


class ReportError(BadInput):
    """The folder cannot be written, or holds something else than a report."""


@dataclass(frozen=True, eq=False)
class PassData:
    """What one pass gave; arrays have one entry a packet, in the order of the capture."""

    title: str
    score: NDArray[np.float64]
    """NaN where a packet has no score."""
    state: NDArray[np.uint8]
    """`sdnator.replay.packet_accounting.PacketState` numbers."""
    decisions: Sequence[Decision] = ()
    confirmations: Sequence[Confirmation] = ()
    reports: Sequence[Incident] = ()
    """Reports of incidents, in the order of writing."""
    incidents: Sequence[Incident] = ()
    """Incidents as they were in the end."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReportData:
    """All that the report shows."""

    title: str
    """For instance the name of the capture."""
    time_ns: NDArray[np.int64]
    """Capture time of each packet, ns since the epoch (UTC)."""
    passes: Sequence[PassData]
    """One or two; the last is the one that files and figures describe."""
    summary: Mapping[str, Any]
    """The object of `sdnator replay --json`; what is missing is not shown."""
    attack: NDArray[np.bool_] | None = None
    """Labels, where there are any."""
    eth_src: NDArray[np.uint64] | None = None
    """Sending MAC of each packet, for the drops in eve.json."""
    ipv4_src: NDArray[np.uint32] | None = None
    """Sending IPv4 address of each packet, 0 = none."""
    notes: Sequence[str] = ()
    line: float = 1.0
    """Score from which on a packet is an anomaly."""

    @property
    def reported(self) -> PassData:
        return self.passes[-1]


def check_folder(folder: str | os.PathLike[str]) -> None:
    """Refuse a folder that cannot take a report, before the work rather than after it.

    Raises:
        ReportError: not writable, not a folder, or full of something else.
    """
    folder = Path(folder)
    try:
        foreign = (
            sorted(path.name for path in folder.iterdir() if path.name not in FILES)
            if folder.is_dir()
            else None
        )
        if foreign is None and folder.exists():
            raise ReportError(f"--report {folder}: is a file; give a folder")
    except OSError as error:
        raise ReportError(
            f"--report {folder}: cannot be written ({error.strerror}); give another folder"
        ) from None
    if foreign:
        raise ReportError(
            f"--report {folder}: the folder holds other things ({', '.join(foreign[:3])}); give a new folder"
        )
    there = folder.absolute().parent
    while not there.exists() and there != there.parent:
        there = there.parent
    try:
        # Asking for permission is not enough: some folders refuse even root.
        Path(tempfile.mkdtemp(prefix=".sdnator-", dir=there)).rmdir()
    except OSError as error:
        raise ReportError(
            f"--report {folder}: {there} is not writable ({error.strerror}); "
            "give another folder or change its permissions"
        ) from None


def write_report(data: ReportData, folder: str | os.PathLike[str]) -> Path:
    """Write the report; a former report in the same folder is replaced, and only by a whole one.

    Returns:
        Path of its `index.html`.

    Raises:
        ReportError: the folder cannot be written, or holds something else.
    """
    folder = Path(folder)
    check_folder(folder)
    part = folder.absolute().with_name(f".{folder.name}.{os.getpid()}.part")
    try:
        part.mkdir(parents=True)
        try:
            _write_files(data, part)
            _put_in_place(part, folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        raise ReportError(
            f"--report {folder}: cannot be written ({error.strerror or error}); give another folder"
        ) from None
    return folder / "index.html"


def _put_in_place(part: Path, folder: Path) -> None:
    old = part.with_suffix(".old")
    if folder.exists():
        folder.replace(old)
    part.replace(folder)
    shutil.rmtree(old, ignore_errors=True)


def _write_files(data: ReportData, folder: Path) -> None:
    png = draw(_curves(data), line=data.line)
    (folder / "scores.png").write_bytes(png)
    shown = data.reported
    report_files.write_scores(folder / "scores.csv", data.time_ns, shown.score, shown.state)
    report_files.write_decisions(folder / "decisions.csv", shown.decisions, shown.confirmations)
    report_files.write_eve(folder / "eve.json", _events(data))
    page = report_page.render(
        title=data.title,
        summary={**data.summary, "blocks": _blocks(data)},
        decisions=report_files.decision_rows(shown.decisions, shown.confirmations),
        incidents=[row(each) for each in shown.incidents],
        notes=data.notes,
        png=png,
        passes=[(each.title, _facts(data, each)) for each in data.passes],
    )
    (folder / "index.html").write_text(page, encoding="utf-8")


def _blocks(data: ReportData) -> list[dict[str, Any]]:
    return report_files.block_rows(data.reported.decisions, data.reported.confirmations)


def _seconds(data: ReportData) -> NDArray[np.float64]:
    if not len(data.time_ns):
        return np.zeros(0)
    return np.asarray((data.time_ns - data.time_ns.min()) / 1e9, dtype=np.float64)


def _curves(data: ReportData) -> list[Curve]:
    seconds = _seconds(data)
    start = int(data.time_ns.min()) if len(data.time_ns) else 0
    curves = []
    for each in data.passes:
        rows = report_files.block_rows(each.decisions, each.confirmations)
        blocks = tuple((row["event_time"] / 1e9 - start / 1e9, str(row["address"])) for row in rows)
        curves.append(Curve(each.title, seconds, each.score, each.state, data.attack, blocks))
    return curves


def _facts(data: ReportData, each: PassData) -> dict[str, float]:
    """Median scores of benign and attack packets of a pass, where labels tell them apart."""
    scored = np.isfinite(each.score) & (each.state == report_files.SCORED)
    attack = data.attack if data.attack is not None else np.zeros(len(scored), np.bool_)
    facts = {}
    for name, chosen in (("benign", scored & ~attack), ("attack", scored & attack)):
        if chosen.any():
            facts[f"median score, {name}"] = float(np.median(each.score[chosen]))
    return facts


def _events(data: ReportData) -> list[dict[str, Any]]:
    shown = data.reported
    events = report_files.incident_events(shown.reports, shown.decisions, shown.confirmations)
    if data.eth_src is not None and data.ipv4_src is not None:
        events += report_files.drop_events(data.time_ns, shown.state, data.eth_src, data.ipv4_src)
    return sorted(events, key=lambda event: str(event["timestamp"]))
