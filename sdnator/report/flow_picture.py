"""The data flow between the apps as a picture: a lane for each app, a row for each key.

It shows what the apps declare, matched as the Coordinator does.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from html import escape
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

from sdnator.app_catalogue import ENFORCERS, OURS

if TYPE_CHECKING:
    from coordinator.matching import Flow
    from due import Interest

ENFORCER_SERVICES = {name: f"apps.enforcers.{name}.service" for name in ENFORCERS}
"""Not in the picture: they run only where the settings name them."""
SERVICES = {**{name: f"apps.{name}.service" for name in OURS}, "dashboard": "sdnator.dashboard.service"}
"""Who declares interests and capabilities, in the order of the lanes."""

_LABELS, _LANE, _TOP, _ROW, _FOOT = 360, 136, 56, 26, 44
_COLOURS = {"text": "#24292f", "quiet": "#6e7781", "lane": "#d0d7de", "paper": "#ffffff", "box": "#f6f8fa"}
_WRITES, _READS = "#0969da", "#bc4c00"


@dataclass(frozen=True)
class Row:
    """One key: who makes it and who takes it."""

    key: str
    producer: str
    consumers: tuple[str, ...]
    reliable: bool
    by_settings: bool = False
    """A consumer asks for it only if its settings say so."""


def rows() -> list[Row]:
    """Every key that one app makes and another may want, in the order of the apps."""
    from coordinator.matching import Declarations, match

    services = {name: import_module(module) for name, module in SERVICES.items()}
    always = {name: Declarations(one.CAPABILITIES, one.INTERESTS) for name, one in services.items()}
    found = _rows(match(always).flows, by_settings=False)
    more = {
        name: Declarations(always[name].capabilities, tuple(_optional_interests(one)))
        for name, one in services.items()
    }
    for key, row in _rows(match(more).flows, by_settings=True).items():
        before = found.get(key)
        consumers = tuple(sorted({*row.consumers, *(before.consumers if before else ())}))
        found[key] = replace(before or row, consumers=consumers)
    return sorted(found.values(), key=lambda row: (list(SERVICES).index(row.producer), row.key))


def _optional_interests(service: ModuleType) -> "Iterator[Interest]":
    for name, value in vars(service).items():
        if name.endswith("_INTERESTS"):
            yield from value


def _rows(flows: "Iterable[Flow]", *, by_settings: bool) -> dict[tuple[str, str], Row]:
    taken: defaultdict[tuple[str, str], set[str]] = defaultdict(set)
    reliable: dict[tuple[str, str], bool] = {}
    for flow in flows:
        capability = flow.capability
        at = (flow.producer, capability.key)
        taken[at].add(flow.consumer)
        reliable[at] = capability.delivery == "reliable"
    return {
        at: Row(at[1], at[0], tuple(sorted(consumers)), reliable[at], by_settings)
        for at, consumers in taken.items()
    }


def svg(found: list[Row]) -> str:
    """The picture; its own colours on its own paper, since it is shown on light and dark pages."""
    width = _LABELS + _LANE * len(SERVICES)
    height = _TOP + _ROW * len(found) + _FOOT
    lanes = {name: _LABELS + _LANE * place + _LANE // 2 for place, name in enumerate(SERVICES)}
    size = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img" font-family="sans-serif" font-size="13">',
        "<title>Data flow between the apps</title>",
        f'<rect width="{width}" height="{height}" rx="8" fill="{_COLOURS["paper"]}"/>',
        *_lanes(lanes, height),
    ]
    for place, row in enumerate(found):
        parts += _row(row, lanes, _TOP + _ROW * place + _ROW // 2)
    parts += _legend(height - 20)
    return "\n".join([*parts, "</svg>"]) + "\n"


def _lanes(lanes: Mapping[str, int], height: int) -> Iterator[str]:
    for name, x in lanes.items():
        left, wide = x - _LANE // 2 + 6, _LANE - 12
        yield (
            f'<line x1="{x}" y1="{_TOP - 12}" x2="{x}" y2="{height - _FOOT}" stroke="{_COLOURS["lane"]}"/>'
        )
        yield (
            f'<rect x="{left}" y="12" width="{wide}" height="30" rx="6" fill="{_COLOURS["box"]}" '
            f'stroke="{_COLOURS["lane"]}"/>'
        )
        yield _text(x, 32, name, anchor="middle", weight="bold")


def _row(row: Row, lanes: Mapping[str, int], y: int) -> Iterator[str]:
    path, colon, _ = row.key.partition(":")
    yield _text(16, y + 4, path + (":…" if colon else ""), family="monospace", size=12)
    ends = [lanes[name] for name in row.consumers if name in lanes]
    start = lanes[row.producer]
    left, right = min(start, *ends), max(start, *ends)
    dash = ' stroke-dasharray="5 4"' if row.by_settings else ""
    wide = 3 if row.reliable else 1.5
    yield (
        f'<line x1="{left}" y1="{y}" x2="{right}" y2="{y}" stroke="{_COLOURS["quiet"]}" '
        f'stroke-width="{wide}"{dash}/>'
    )
    yield f'<circle cx="{start}" cy="{y}" r="6" fill="{_WRITES}"/>'
    for end in ends:
        way = -1 if end > start else 1
        yield f'<path d="M{end} {y} l{way * 11} -6 v12 z" fill="{_READS}"/>'


def _legend(y: int) -> Iterator[str]:
    line = _COLOURS["quiet"]
    yield f'<circle cx="22" cy="{y - 4}" r="6" fill="{_WRITES}"/>'
    yield _text(34, y, "writes")
    yield f'<path d="M102 {y - 4} l-11 -6 v12 z" fill="{_READS}"/>'
    yield _text(110, y, "receives")
    for x, wide, dash, text in (
        (190, 3, "", "reliable: acknowledged, replayable"),
        (470, 1.5, "", "best effort: loss is counted"),
        (700, 3, ' stroke-dasharray="5 4"', "only where settings ask"),
    ):
        yield (
            f'<line x1="{x}" y1="{y - 4}" x2="{x + 30}" y2="{y - 4}" stroke="{line}" '
            f'stroke-width="{wide}"{dash}/>'
        )
        yield _text(x + 38, y, text)


def _text(
    x: int, y: int, text: str, *, anchor: str = "start", weight: str = "", family: str = "", size: int = 0
) -> str:
    more = "".join(
        f' {name}="{value}"'
        for name, value in (("font-weight", weight), ("font-family", family), ("font-size", size))
        if value
    )
    return (
        f'<text x="{x}" y="{y}" text-anchor="{anchor}" fill="{_COLOURS["text"]}"{more}>{escape(text)}</text>'
    )
