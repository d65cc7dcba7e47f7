"""Options of the two charts.  Pure; the colours do for light and dark."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from functools import lru_cache
from html import escape
from math import ceil, log10
from typing import Any

from due.keys import Key
from sdnator.dashboard.board import Bin
from sdnator.dashboard.texts import number

GREY, BLUE, RED, AMBER = "#8a8f98", "#3b82d6", "#d9534f", "#e0a030"
_LEAST_SCORE = 0.001
_LEAST_SHOWN = 0.05
_TOLD = 12
_NO_MARKUP = str.maketrans("{}", "()")
Point = list[float | None]
_SILENCE_S = 3.0
"""Kitsune speaks more often than this while packets come."""
_GRID = "rgba(128,128,128,0.18)"
_PLACES = {
    "p4runtime_ctrl": (12, 52),
    "kitsune": (38, 88),
    "sonata_adapter": (38, 18),
    "firewall": (66, 52),
    "dashboard": (90, 88),
    "coordinator": (90, 18),
}


def score_chart() -> dict[str, Any]:
    """Highest and mean score over time, and the line between normal and not."""
    axis = {"axisLabel": {"color": GREY, "hideOverlap": True}, "splitLine": {"lineStyle": {"color": _GRID}}}
    line = {"type": "line", "showSymbol": True, "symbolSize": 2, "connectNulls": False, "data": []}
    return {
        "animation": False,
        "grid": {"left": 48, "right": 64, "top": 34, "bottom": 26},
        "legend": {"top": 0, "left": 40, "textStyle": {"color": GREY}, "itemHeight": 8},
        "tooltip": {"trigger": "axis"},
        "xAxis": {"type": "time", **axis},
        "yAxis": {"type": "log", "min": _LEAST_SCORE, "max": top([], None), **axis},
        "series": [
            {
                **line,
                "name": "highest score",
                "lineStyle": {"color": RED, "width": 1.5},
                "itemStyle": {"color": RED},
                "markLine": threshold(None),
            },
            {
                **line,
                "name": "mean score",
                "lineStyle": {"color": BLUE, "width": 1.5},
                "itemStyle": {"color": BLUE},
                "areaStyle": {"color": BLUE, "opacity": 0.12},
            },
        ],
    }


def threshold(value: float | None) -> dict[str, Any]:
    """The line over which a packet is anomalous; none while it is not known."""
    return {
        "silent": True,
        "symbol": "none",
        "lineStyle": {"color": AMBER, "type": "dashed", "width": 1.5},
        "label": {"formatter": "threshold\n{c}", "position": "end", "color": AMBER, "lineHeight": 15},
        "data": [] if value is None else [{"yAxis": value}],
    }


def top(scores: Iterable[float], line: float | None) -> float:
    """End of the axis: a power of ten that scores and line have room below; ECharts finds none without scores."""
    return 10.0 ** ceil(log10(min(1e12, max(10.0, line or 0.0, *scores))))


def score_points(bins: Iterable[Bin], width: float) -> tuple[list[Point], list[Point]]:
    """Points of both series: time in ms, score; None between slices where nothing came: silence is a gap.

    Args:
        bins: slices of time that had packets, in order.
        width: of a slice, s.
    """
    highest: list[Point] = []
    mean: list[Point] = []
    last = None
    for each in bins:
        if each.count:
            at = round(each.start * 1e3)
            if last is not None and each.start - last > max(_SILENCE_S, width):
                for series in (highest, mean):
                    series.append([round((last + width) * 1e3), None])
            last = each.start
            highest.append([at, max(_LEAST_SCORE, round(each.highest, 4))])
            mean.append([at, max(_LEAST_SCORE, round(each.total / each.count, 4))])
    return highest, mean


def flow_chart(
    apps: Iterable[Mapping[str, Any]],
    flow: Iterable[Mapping[str, Any]],
    rates: Mapping[str, tuple[float, float]],
    by_key: Mapping[str, Mapping[str, float]],
) -> dict[str, Any]:
    """Apps as nodes with what they write and receive a second; who gets what from whom as edges.

    `by_key`: items a second of each key that an app writes; an edge has those its interests match.
    """
    keys: defaultdict[tuple[str, str], set[str]] = defaultdict(set)
    for one in flow:
        if one["producer"] != one["consumer"]:
            keys[one["producer"], one["consumer"]].add(str(one["interest"]).partition(":")[0])
    names = sorted({str(app["app_id"]) for app in apps} | {name for pair in keys for name in pair})
    strangers = [name for name in names if name not in _PLACES]
    hidden = {"show": False, "min": 0, "max": 100}
    return {
        "animation": False,
        "tooltip": {"confine": True},
        "grid": {"left": 30, "right": 30, "top": 10, "bottom": 50},
        "xAxis": hidden,
        "yAxis": hidden,
        "series": [
            {
                "type": "graph",
                "coordinateSystem": "cartesian2d",
                "symbolSize": 24,
                "edgeSymbol": ["none", "arrow"],
                "edgeSymbolSize": 8,
                "label": {
                    "show": True,
                    "position": "bottom",
                    "color": GREY,
                    "lineHeight": 15,
                    "align": "center",
                },
                "lineStyle": {"color": GREY, "opacity": 0.7},
                "data": [_node(name, rates, strangers) for name in names],
                "links": [_edge(pair, sorted(found), by_key) for pair, found in sorted(keys.items())],
            }
        ],
    }


def _node(name: str, rates: Mapping[str, tuple[float, float]], strangers: list[str]) -> dict[str, Any]:
    written, received = rates.get(name, (0.0, 0.0))
    text = f"{name}: writes {number(written)}, receives {number(received)} items a second"
    return {
        "name": name,
        "value": _PLACES.get(name) or (8 + 14 * (strangers.index(name) % 7), 0),
        "itemStyle": {"color": BLUE if name in _PLACES else AMBER},
        # a label is drawn, not HTML, but {…} is markup there
        "label": {
            "formatter": f"{name.translate(_NO_MARKUP)}\n▲ {number(written)}/s  ▼ {number(received)}/s"
        },
        "tooltip": {"formatter": as_html(text)},
    }


def _edge(
    pair: tuple[str, str], interests: list[str], by_key: Mapping[str, Mapping[str, float]]
) -> dict[str, Any]:
    producer, consumer = pair
    written = by_key.get(producer, {})
    goes = {key: {interest for interest in interests if _wants(interest, key)} for key in written}
    wanted = {
        interest: sum(written[key] for key in written if interest in goes[key]) for interest in interests
    }
    total = sum(written[key] for key in written if goes[key])
    lines = [
        f"{interest} {number(wanted[interest])}/s" if written else interest
        for interest in sorted(interests, key=lambda one: -wanted[one])[:_TOLD]
    ]
    return {
        "source": producer,
        "target": consumer,
        "lineStyle": {"width": 1 + min(4.0, len(str(int(total))) * 0.7), "curveness": 0.16},
        "label": {
            "show": total >= _LEAST_SHOWN,
            "formatter": f"{number(total)}/s",
            "color": GREY,
            "fontSize": 10,
        },
        "tooltip": {"formatter": "<br>".join(map(as_html, [f"{producer} → {consumer}", *lines]))},
    }


def as_html(text: str) -> str:
    """A text for a tooltip, which ECharts takes as HTML with {…} as its own variables: names come from outside."""
    return escape(text).replace("{", "&#123;").replace("}", "&#125;")


@lru_cache(maxsize=4096)
def _wants(interest: str, key: str) -> bool:
    return Key.parse(interest).matches_path(key)
