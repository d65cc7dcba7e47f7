"""The picture of a replay: anomaly score of each packet over time, one plot a pass, as a PNG.

matplotlib's object interface with the Agg canvas: no display, no global state.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sdnator.replay.packet_accounting import PacketState

BENIGN, ATTACK, DROPPED, BLOCK, INK = "#3b78c3", "#d1342f", "#e08a00", "#111111", "#555555"
FLOOR, CEILING = 1e-3, 1e4
"""Scores outside are drawn at the edge: some are rounding noise, some are 1e16 by construction."""
_STRIP: Final = FLOOR / 3
_GLIMPSE: Final = 0.12
"""Training shown, as a share of the time with scores."""
_SIZE_INCHES, _DPI = (12.0, 7.6), 120
_MOST_NAMES: Final = 8
"""Blocks named in the picture; the others are lines only."""


@dataclass(frozen=True, eq=False)
class Curve:
    """What one plot shows; arrays have one entry a packet."""

    title: str
    time_s: NDArray[np.float64]
    """Seconds since the start of the capture."""
    score: NDArray[np.float64]
    """NaN where a packet has none."""
    state: NDArray[np.uint8]
    """`PacketState` numbers."""
    attack: NDArray[np.bool_] | None
    """Labels, where there are any."""
    blocks: tuple[tuple[float, str], ...] = ()
    """Time and address of each block, in order of time."""


def draw(curves: Sequence[Curve], *, line: float = 1.0) -> bytes:
    """A PNG with one plot below the other, on one time axis.

    Args:
        curves: at least one.
        line: score from which on a packet is an anomaly.
    """
    figure = Figure(figsize=(_SIZE_INCHES[0], 0.9 + len(curves) * (_SIZE_INCHES[1] - 0.9) / 2), dpi=_DPI)
    FigureCanvasAgg(figure)
    plots = figure.subplots(len(curves), 1, sharex=True, squeeze=False)[:, 0]
    scale, unit = _time_unit(curves)
    for plot, curve in zip(plots, curves, strict=True):
        _draw_curve(plot, curve, scale, line)
    plots[-1].set_xlabel(f"time since the start of the capture ({unit})", color=INK)
    _legend(figure, curves)
    figure.tight_layout(rect=(0, 0, 1, 0.955))
    data = io.BytesIO()
    figure.savefig(data, format="png", metadata={"Software": "SDNator"})
    return data.getvalue()


def _time_unit(curves: Sequence[Curve]) -> tuple[float, str]:
    longest = max((float(curve.time_s.max()) for curve in curves if len(curve.time_s)), default=0.0)
    return (60.0, "min") if longest > 600 else (1.0, "s")


def _draw_curve(plot: Any, curve: Curve, scale: float, line: float) -> None:
    time = curve.time_s / scale
    _mark_training(plot, curve, time)
    shown = (curve.state == PacketState.SCORED) & np.isfinite(curve.score)
    attack = curve.attack if curve.attack is not None else np.zeros(len(time), np.bool_)
    for chosen, colour, size, layer in (
        (shown & ~attack, BENIGN, 1.1, 2),
        (shown & attack, ATTACK, 1.6, 3),
    ):
        heights = np.clip(curve.score[chosen], FLOOR, CEILING)
        plot.plot(time[chosen], heights, ".", color=colour, ms=size, mew=0, zorder=layer, rasterized=True)
    dropped = curve.state == PacketState.DROPPED
    if dropped.any():
        # drawn below the axis of scores: a dropped packet has none
        jitter = np.random.RandomState(1).uniform(-0.16, 0.16, int(dropped.sum()))
        plot.plot(
            time[dropped], _STRIP * 10**jitter, ",", color=DROPPED, alpha=0.9, zorder=3, rasterized=True
        )
    plot.axhline(line, color=INK, linewidth=0.9, linestyle=(0, (5, 4)), zorder=4)
    plot.set_yscale("log")
    plot.set_ylim(_STRIP / 2.2, _top(curve))
    powers = [10.0**power for power in range(-3, 5) if 10.0**power <= _top(curve)]
    plot.set_yticks(powers, [f"{power:g}" for power in powers])
    plot.set_yticks([], minor=True)
    plot.set_xlim(*_span(curve, time))
    plot.set_ylabel("anomaly score (RMSE)", color=INK)
    plot.set_title(curve.title, loc="left", fontsize=11, fontweight="bold")
    plot.grid(visible=True, axis="y", linewidth=0.4, color="#dddddd")
    plot.spines[["top", "right"]].set_visible(False)
    _mark_blocks(plot, curve, scale)


def _top(curve: Curve) -> float:
    finite = curve.score[np.isfinite(curve.score)]
    highest = float(finite.max()) if len(finite) else 1.0
    return float(np.clip(highest * 6, 100.0, CEILING * 2))


def _span(curve: Curve, time: NDArray[np.float64]) -> tuple[float, float]:
    """All of the time that has scores and a glimpse of the training before it."""
    end = float(time.max()) if len(time) else 0.0
    trained = np.flatnonzero(curve.state == PacketState.TRAIN)
    trained_until = float(time[trained[-1]]) if len(trained) else 0.0
    begin = max(0.0, trained_until - _GLIMPSE * (end - trained_until)) if end > trained_until else 0.0
    return begin, max(end, begin + 1e-3)


def _mark_training(plot: Any, curve: Curve, time: NDArray[np.float64]) -> None:
    trained = np.flatnonzero(curve.state == PacketState.TRAIN)
    if not len(trained):
        return
    end = float(time[trained[-1]])
    plot.axvspan(0, end, color="#f1f1ee", zorder=0)
    plot.text(
        *((_span(curve, time)[0] + end) / 2, 1.5),
        f"training\n{len(trained):,} packets,\nno scores",
        ha="center",
        va="bottom",
        color="#777777",
        fontsize=8.5,
    )


def _mark_blocks(plot: Any, curve: Curve, scale: float) -> None:
    begin, end = plot.get_xlim()
    transform = plot.get_xaxis_transform()
    for number, (seconds, name) in enumerate(curve.blocks):
        at = seconds / scale
        plot.axvline(at, color=BLOCK, linewidth=1.0, zorder=5)
        if number < _MOST_NAMES:
            left = at > begin + 0.6 * (end - begin)
            plot.annotate(
                f" blocked {name} ",
                (at, 0.96 - 0.09 * (number % 4)),
                xycoords=transform,
                ha="right" if left else "left",
                va="top",
                fontsize=8.5,
                zorder=6,
                bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85},
            )


def _legend(figure: Figure, curves: Sequence[Curve]) -> None:
    from matplotlib.lines import Line2D

    def dot(colour: str, text: str) -> Line2D:
        return Line2D([], [], marker="o", linestyle="", markersize=5, color=colour, label=text)

    labelled = any(curve.attack is not None for curve in curves)
    handles = [dot(BENIGN, "benign packet" if labelled else "packet")]
    if labelled:
        handles.append(dot(ATTACK, "attack packet"))
    if any((curve.state == PacketState.DROPPED).any() for curve in curves):
        handles.append(dot(DROPPED, "dropped by the switch (no score)"))
    handles.append(Line2D([], [], color=INK, linewidth=0.9, linestyle=(0, (5, 4)), label="threshold"))
    if any(curve.blocks for curve in curves):
        handles.append(Line2D([], [], color=BLOCK, linewidth=1.0, label="block"))
    figure.legend(handles=handles, loc="upper right", ncols=len(handles), frameon=False, fontsize=9)
