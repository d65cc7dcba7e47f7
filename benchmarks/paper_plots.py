"""Pictures of the paper's benchmark: latency and throughput by size, the archive by batch, the star by latency.

Each takes the cells of its group as `benchmarks.paper` keeps them, and bars from the least to the most of the rounds.
"""

import re
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

_COLOURS: Final = {
    "due best_effort": "#2f8f5b",
    "due reliable": "#5b7fa6",
    "due in one process": "#7a5ba6",
    "raw": "#d9a441",
    "os-ken": "#9aa7b5",
    "sqlite": "#2f8f5b",
    "mongodb": "#5b7fa6",
}
_NAMES: Final = {
    "due best_effort": "DUE, best effort",
    "due reliable": "DUE, reliable",
    "due in one process": "DUE in one process",
    "raw": "raw Redis",
    "sqlite": "SQLite",
    "mongodb": "MongoDB's protocol",
}
_CELL: Final = re.compile(r"(.+) (\d+) B batch (\d+)")
Cells = Mapping[str, Any]


def draw(cells: Mapping[str, Cells], folder: Path) -> list[Path]:
    """Draw what was measured; returns the pictures in the order in which the page shows them.

    Args:
        cells: by group, as in the JSON; groups that are missing are left out.
        folder: that exists.
    """
    found = []
    pictures: Mapping[str, Callable[[Cells], Figure]] = {
        "messages": _messages,
        "archive": _archive,
        "star": _star,
    }
    for group, make in pictures.items():
        if cells.get(group):
            path = folder / f"{group}.png"
            figure = make(cells[group])
            FigureCanvasAgg(figure)
            figure.savefig(path, dpi=120)
            found.append(path)
    return found


def _messages(cells: Cells) -> Figure:
    figure = Figure(figsize=(10.5, 4.4), layout="constrained")
    panels = (
        ("latency_p50_us", "Latency, median of a message", "µs"),
        ("per_second", "Throughput", "messages/s"),
    )
    for place, (field, title, unit) in enumerate(panels, start=1):
        axes = figure.add_subplot(1, 2, place)
        for (name, batch), points in sorted(_by_size(cells, field).items()):
            _line(
                axes, points, _COLOURS[name], f"{_NAMES.get(name, name)}, batch {batch}",
                style="-" if batch == 1 else "--",
            )  # fmt: skip
        if field == "per_second":
            axes.axhline(100_000, color="#b00020", linewidth=0.8, linestyle=":")
        axes.set(xscale="log", yscale="log", xlabel="bytes of a message", ylabel=unit, title=title)
        axes.legend(fontsize=7, frameon=False)
    return figure


def _by_size(cells: Cells, field: str) -> dict[tuple[str, int], list[tuple[float, Any]]]:
    found: dict[tuple[str, int], list[tuple[float, Any]]] = {}
    for text, cell in cells.items():
        match = _CELL.fullmatch(text)
        if match is not None and field in cell:
            found.setdefault((match[1], int(match[3])), []).append((float(match[2]), cell[field]))
    return found


def _archive(cells: Cells) -> Figure:
    figure = Figure(figsize=(10.5, 3.8), layout="constrained")
    left, right = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2)
    measured = {name: cell for name, cell in cells.items() if isinstance(cell, Mapping)}
    for place, (name, cell) in enumerate(measured.items()):
        batches = [
            (float(text.split()[1]), value) for text, value in cell.items() if text.startswith("batch")
        ]
        _line(left, batches, _COLOURS[name], _NAMES[name])
        for at, (mode, label) in enumerate((("off", "archive off"), ("on", "archive on"))):
            value = cell[mode]
            right.bar(
                place + (at - 0.5) * 0.36, value["median"], 0.34, yerr=_error([value]), capsize=3,
                color=_COLOURS[name], alpha=1.0 if mode == "on" else 0.45, label=f"{_NAMES[name]}, {label}",
            )  # fmt: skip
    left.set(
        xscale="log", yscale="log", xlabel="items of a batch", ylabel="archived/s", title="Archive alone"
    )
    left.legend(fontsize=7, frameon=False)
    right.set_xticks(range(len(measured)), [_NAMES[name] for name in measured])
    right.set(ylabel="published/s", title="Publisher, unthrottled")
    right.legend(fontsize=7, frameon=False, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.1))
    return figure


def _star(cells: Cells) -> Figure:
    figure = Figure(figsize=(10.5, 3.8), layout="constrained")
    runs = cells["runs"]
    panels: Iterable[tuple[str, str, str]] = (
        ("sum_mbit", f"Sum of all apps, links of {cells['link_mbit']:.3g} Mb/s", "Mb/s"),
        ("jain", "Fairness: Jain's index", ""),
    )
    for place, (field, title, unit) in enumerate(panels, start=1):
        axes = figure.add_subplot(1, 2, place)
        counts = sorted({run["pairs"] for run in runs})
        for pairs, colour in zip(counts, ("#d9a441", "#5b7fa6", "#2f8f5b", "#9aa7b5"), strict=False):
            points = [
                (
                    delay * 2_000,
                    _spread(
                        [run[field] for run in runs if (run["pairs"], run["one_way_s"]) == (pairs, delay)]
                    ),
                )
                for delay in sorted({run["one_way_s"] for run in runs})
            ]
            _line(axes, points, colour, f"{2 * pairs} apps")
        axes.set(xlabel="added round trip, ms", ylabel=unit, title=title)
        axes.set_ylim(0 if field == "sum_mbit" else 0.5, None if field == "sum_mbit" else 1.02)
        axes.legend(fontsize=7, frameon=False)
    return figure


def _spread(values: Sequence[float]) -> dict[str, float]:
    return {"median": statistics.median(values), "least": min(values), "most": max(values)}


def _line(
    axes: Any,
    points: Sequence[tuple[float, Mapping[str, float]]],
    colour: str,
    label: str,
    *,
    style: str = "-",
) -> None:
    ordered = sorted(points, key=lambda point: point[0])
    values = [value for _, value in ordered]
    axes.errorbar(
        [at for at, _ in ordered], [one["median"] for one in values], yerr=_error(values), color=colour,
        label=label, linestyle=style, marker="o", markersize=3, capsize=2, linewidth=1.2,
    )  # fmt: skip


def _error(values: Sequence[Mapping[str, float]]) -> list[list[float]]:
    return [
        [one["median"] - one["least"] for one in values],
        [one["most"] - one["median"] for one in values],
    ]
