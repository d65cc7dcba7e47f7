"""From the outcome of a replay to its report."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sdnator.replay.loop import PassResult
from sdnator.replay.run import ReplayOutcome
from sdnator.report.writer import PassData, ReportData, write_report


def write_replay_report(folder: Path, outcome: ReplayOutcome, figures: Mapping[str, Any]) -> Path:
    """Write the report of a replay; returns the path of its `index.html`, raises ReportError."""
    passes = []
    if outcome.dry_run is not None:
        passes.append(_pass_data("Kitsune alone", outcome.dry_run))
    if outcome.blocking is not None:
        passes.append(_pass_data("with blocking", outcome.blocking))
    survey = outcome.survey
    data = ReportData(
        title=survey.path.name,
        time_ns=survey.time_ns,
        passes=passes,
        summary=figures,
        attack=outcome.labels.attack if outcome.labels is not None else None,
        eth_src=survey.eth_src,
        ipv4_src=survey.ipv4_src,
        notes=outcome.notes,
    )
    return write_report(data, folder)


def _pass_data(title: str, result: PassResult) -> PassData:
    return PassData(
        title,
        result.flight.score,
        result.flight.state,
        result.decisions,
        result.confirmations,
        result.incidents,
        result.last_incidents(),
    )
