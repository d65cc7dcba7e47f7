"""Query plans as text."""

from collections.abc import Mapping
from typing import Any

from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.planner.placement import StageEntry
from apps.sonata_adapter.planner.plan import QueryPlans
from apps.sonata_adapter.planner.refinement import MOST, coarsest
from apps.sonata_adapter.planner.refinement_levels import levels_of
from apps.sonata_adapter.query.language import duration_text

_WHOLE = 128
"""Bits of an address in a cell's key."""


def explain(
    request: QueryRequest,
    found: QueryPlans,
    *,
    meaning: str = "",
    count: str = "",
    cells: Mapping[int, str] | None = None,
) -> str:
    """The plan of one query as a text diagram; for a refined query, while no prefix crosses.

    Args:
        request: the query.
        found: plans, that of the query among them.
        meaning: of the query, in words.
        count: identity under which it is planned, if not its own.
        cells: by bit, the cells of its entries in words; by default their number.
    """
    planned = {query.identity for query in found.queries}
    first = coarsest(request)
    one = found.of(count or (first.identity if first.identity in planned else request.identity))
    lines = [request.identity]
    if meaning:
        lines.append(f"  {meaning}")
    lines += ["", *(f"  {line}" for line in request.query.text().splitlines()[1:]), ""]
    lines += _level_lines(request)
    lines.append(f"  in the switch{'' if one.in_switch else ': only copies, because ' + one.reason}")
    for entry in one.entries:
        lines += _entry_lines(entry, (cells or {}).get(entry.bit, f"{entry.size:,} cells"))
    for copy in one.copies:
        what = "frames" if copy.payload else "headers"
        lines.append(f"    bit {copy.bit:<3} copies {what} of {match_text(copy.match)}")
    if one.gate is not None:
        lines.append(f"    bit {one.gate.opens:<3} copies frames that have passed the gate")
        lines.append(f"    bit {one.gate.uncounted:<3} copies frames of keys without a cell")
    lines.append("  on the host")
    if one.gate is not None:
        lines.append(
            "    all operators, on what has passed the gate; the gate itself for keys without a cell"
        )
    elif any(entry.role == "clock" for entry in one.entries):
        lines.append("    keys that may become results; their other counts are read when the window is over")
    elif any(entry.role == "difference" for entry in one.entries):
        lines.append("    keys at or above the threshold when the window is over; keys without a cell")
    elif one.in_switch:
        lines.append("    keys that reached the threshold, reported once in a window; keys without a cell")
    of_all = "" if found.measured else " of 10,000 packets"
    if one.in_switch:
        lines.append(f"    saves about {one.saved_per_second:,.0f} copies a second{of_all}")
    else:
        lines.append(f"    all operators, on about {one.tuples_per_second:,.0f} tuples a second{of_all}")
    lines.append(f"    results for windows of {duration_text(request.query.window_ms)}")
    return "\n".join(lines)


def _level_lines(request: QueryRequest) -> list[str]:
    levels = levels_of(request)
    if not levels:
        return []
    names = [f"/{level} (IPv6: /{4 * level})" for level in levels[:-1]] + ["addresses, which are the results"]
    delay = duration_text(len(levels) * request.query.window_ms)
    return [
        "  refined, one window a level",
        f"    1. counts by {names[0]}, all the time: the plan below",
        *(
            f"    {place}. below each /{levels[place - 2]} that crosses, and a window longer: {name}"
            for place, name in enumerate(names[1:], 2)
        ),
        f"    at most {MOST} prefixes at a time; if more cross, addresses of all packets",
        f"    an attack is reported from its window {len(levels)} on, at the latest {delay} after it began",
    ]


def _entry_lines(entry: StageEntry, cells: str) -> list[str]:
    if entry.role == "clock":
        period = duration_text(entry.window_us // 1000)
        return [
            f"    bit {entry.bit:<3} {match_text(entry.match)}",
            f"      stage {entry.stage}: reports its clock every {period}, so that windows end",
        ]
    key = ", ".join(name.removesuffix("_mask") + _prefix_text(name, mask) for name, mask in entry.masks)
    unit = "bytes" if entry.by_bytes else "frames"
    what = {
        "distinct": f"lets new ({key}) pass",
        "reduce": f"counts {unit} by ({key}), reports {entry.threshold}",
        "difference": _difference_text(entry, unit, key),
        "gate": f"counts frames by ({key}), lets them pass from {entry.threshold} on",
        "look": f"lets frames pass whose ({key}){_side(entry)} has passed",
    }[entry.role]
    return [
        f"    bit {entry.bit:<3} {match_text(entry.match)}",
        f"      stage {entry.stage}: {what}, {cells}",
    ]


def _difference_text(entry: StageEntry, unit: str, key: str) -> str:
    sign = "subtracts" if entry.subtracts else "adds"
    at_end = f", reports {entry.threshold} at the window's end" if entry.bit == entry.count_of else ""
    return f"{sign} {unit} by ({key}){_side(entry)}{at_end}"


def _side(entry: StageEntry) -> str:
    return ", of answers" if entry.answers else ""


def _prefix_text(name: str, mask: int) -> str:
    cut = name in ("source_mask", "destination_mask") and mask.bit_count() < _WHOLE
    return f" /{mask.bit_count()}" if cut else ""


def match_text(match: Mapping[str, Any]) -> str:
    """A condition of the classifier as text."""
    if not match:
        return "every packet"
    parts = []
    for name, value in sorted(match.items()):
        if name == "ethertype":
            parts.append(
                {0x0800: "IPv4", 0x86DD: "IPv6", 0x0806: "ARP"}.get(value, f"ethertype {value:#06x}")
            )
        elif name in ("sport", "dport"):
            parts.append(f"{name} {value[0]}" if value[0] == value[1] else f"{name} {value[0]}-{value[1]}")
        elif name == "tcp_flags":
            parts.append(f"flags & {value[1]:#04x} == {value[0]:#04x}")
        elif name != "l4_valid":
            parts.append(f"{name} {value}")
    return ", ".join(parts)
