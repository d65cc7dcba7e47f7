"""The report of a SYN flood demo: one picture of both floods, and the figures as JSON.

    tcp connections    attempts by the moment they began: connected while the flood went on, or not
    SYNs a second      what the attacker sent
    half-open          at the victim, of its backlog
                       rules are marked where the switch confirmed them

matplotlib's object interface with the Agg canvas: no display, no global state.
"""

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sdnator.demos.syn_flood.lab import BACKLOG
from sdnator.demos.syn_flood.records import Records
from sdnator.demos.syn_flood.trial import TrialOutcome
from sdnator.errors import BadInput

if TYPE_CHECKING:
    from apps.messages import Confirmation

CONNECTED, FAILED, UNDECIDED, SENT, HALF_OPEN, RULE, INK = (
    "#3b78c3",
    "#d1342f",
    "#c9c9c4",
    "#8a6fb0",
    "#e08a00",
    "#111111",
    "#555555",
)
_SIZE_INCHES, _DPI = (12.0, 7.2), 120
_BIN_S: Final = 0.5
_MARGIN_S: Final = 0.5
_MOST_RULES: Final = 3


@dataclass(frozen=True)
class Panel:
    """One flood, times in seconds from its first SYN."""

    title: str
    seconds: float
    connected: Sequence[float]
    """When attempts began that connected before the flood's end."""
    failed: Sequence[float]
    undecided: Sequence[float]
    """When attempts began that were still trying at the flood's end."""
    sent: Sequence[tuple[float, float]]
    """Middle of an interval, SYNs a second in it."""
    half_open: Sequence[tuple[float, int]]
    rules: Sequence[tuple[float, str]]


def panel(
    title: str, outcome: TrialOutcome, records: Records, confirmed: Sequence[tuple[float, "Confirmation"]]
) -> Panel:
    """What the records have of one flood."""
    first, address = outcome.first, outcome.trial.address
    seconds = outcome.end - first
    shown = [each for each in records.towards(address) if -_MARGIN_S <= each.at - first <= seconds]
    return Panel(
        title=title,
        seconds=seconds,
        connected=[each.at - first for each in shown if each.connected_by(outcome.end)],
        failed=[each.at - first for each in shown if each.ok is False and each.ended <= outcome.end],
        undecided=[each.at - first for each in shown if each.ok is None or each.ended > outcome.end],
        sent=_rates(records.floods[address]),
        half_open=[
            (at - first, seen.get(address, 0))
            for at, seen in records.half_open
            if -_MARGIN_S <= at - first <= seconds
        ],
        rules=_rules(outcome, confirmed),
    )


def _rates(flood: dict[str, Any]) -> list[tuple[float, float]]:
    before, rates = flood["first"], []
    for at, number in flood["tally"]:
        if at > before:
            rates.append(((before + at) / 2 - flood["first"], number / (at - before)))
        before = at
    return rates


def _rules(
    outcome: TrialOutcome, confirmed: Sequence[tuple[float, "Confirmation"]]
) -> list[tuple[float, str]]:
    """The rules against this flood; many blocks at a time are one mark."""
    found: dict[str, tuple[float, list[str]]] = {}
    for at, said in confirmed:
        during = outcome.first <= at <= outcome.end and said.state == "installed"
        if during and said.target is not None and said.action in ("block", "protect"):
            found.setdefault(said.action, (at - outcome.first, []))[1].append(said.target.address)
    marks = []
    for action, (at, targets) in found.items():
        more = f" and {len(targets) - 1} more" if len(targets) > 1 else ""
        marks.append((at, f"{action} {targets[0]}{more}"))
    if outcome.trial.protection == "armed" and outcome.challenged_ms is not None:
        marks.insert(0, (outcome.challenged_ms / 1000, "guard: first SYN challenged"))
    return marks[:_MOST_RULES]


def write_report(folder: Path, figures: dict[str, Any], panels: Sequence[Panel]) -> Path:
    """Write `syn_flood.json` and `syn_flood.png`; returns the picture's path."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "syn_flood.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
        path = folder / "syn_flood.png"
        path.write_bytes(picture(panels))
    except OSError as error:
        raise BadInput(
            f"--report {folder}: cannot be written ({error.strerror}); give another folder"
        ) from error
    return path


def picture(panels: Sequence[Panel]) -> bytes:
    """The picture as a PNG, a column for each flood."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE_INCHES, dpi=_DPI)
    rows = figure.subplots(3, len(panels), squeeze=False, sharex="col", sharey="row")
    for column, shown in enumerate(panels):
        _attempts(rows[0][column], shown)
        _line(rows[1][column], shown.sent, SENT)
        _line(rows[2][column], shown.half_open, HALF_OPEN)
        rows[2][column].axhline(BACKLOG, color=INK, linewidth=0.9, linestyle=(0, (5, 4)))
        rows[2][column].set_xlabel("seconds from the first SYN")
        for plot in rows[:, column]:
            _tidy(plot, shown)
        _name_rules(rows[0][column], shown)
    for plot, label in zip(rows[:, 0], ("connection attempts", "SYNs a second", "half-open"), strict=True):
        plot.set_ylabel(label)
    rows[1][0].set_ylim(0, 1.15 * max((rate for shown in panels for _, rate in shown.sent), default=1.0))
    rows[2][0].annotate(f"backlog {BACKLOG}", (0, BACKLOG), va="bottom", color=INK, fontsize=8.5)
    rows[2][0].set_ylim(0, BACKLOG * 1.2)
    _legend(figure)
    figure.tight_layout(rect=(0, 0, 1, 0.96))
    data = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(data, format="png", metadata={"Software": "SDNator"})
    return data.getvalue()


def _attempts(plot: Any, shown: Panel) -> None:
    edges = [each * _BIN_S for each in range(-1, int(shown.seconds / _BIN_S) + 2)]
    attempts = [shown.connected, shown.failed, shown.undecided]
    colours = [CONNECTED, FAILED, UNDECIDED]
    plot.hist(attempts, bins=edges, stacked=True, color=colours, rwidth=0.9)
    plot.yaxis.get_major_locator().set_params(integer=True)
    plot.set_title(shown.title, loc="left", fontsize=11)


def _line(plot: Any, points: Sequence[tuple[float, float]], colour: str) -> None:
    plot.plot([at for at, _ in points], [value for _, value in points], color=colour, linewidth=1.4)


def _tidy(plot: Any, shown: Panel) -> None:
    plot.set_xlim(-_MARGIN_S, shown.seconds)
    plot.axvspan(0, shown.seconds, color="#f6f1f1", zorder=0)
    plot.grid(axis="y", color="#e4e4e0", linewidth=0.8)
    plot.set_axisbelow(True)
    for side in ("top", "right"):
        plot.spines[side].set_visible(False)
    for at, _ in shown.rules:
        plot.axvline(at, color=RULE, linewidth=1.0, zorder=5)


def _name_rules(plot: Any, shown: Panel) -> None:
    plot.set_ylim(top=plot.get_ylim()[1] * 1.35)
    for number, (at, text) in enumerate(shown.rules):
        plot.annotate(
            f" {text}, {at * 1000:,.0f} ms ",
            (at, 0.98 - 0.12 * number),
            xycoords=plot.get_xaxis_transform(),
            va="top",
            fontsize=8.5,
            zorder=6,
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.9},
        )


def _legend(figure: Any) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Patch(color=CONNECTED, label="connected"),
        Patch(color=FAILED, label="failed"),
        Patch(color=UNDECIDED, label="still trying at the flood's end"),
        Line2D([], [], color=RULE, linewidth=1.0, label="rule in the switch"),
    ]
    figure.legend(handles=handles, loc="upper right", ncols=len(handles), frameon=False, fontsize=9)
