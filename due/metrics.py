"""Health as Prometheus text.  Pure: numbers in, text out.

    engine.health() ──► due_…{app, instance}        names, units and types are listed below
    Service.health() ──► <app>_…{instance}          names as the app gives them; units are written out

What an app reports has no declared type, so its samples are untyped.  Truth values are 0 and 1, lists
of maps get the label `name` (or `index`), lists of anything else are counted, text is left out.
"""

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

_UNITS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_NAMES = ("name", "switch", "id")


class _Family(NamedTuple):
    name: str
    kind: str
    text: str


_ENGINE: dict[str, _Family] = {
    path: _Family(f"due_{name}{'_total' if kind == 'counter' else ''}", kind, text)
    for path, name, kind, text in (
        ("active", "active", "gauge", "1 if this instance is active"),
        ("asking", "asking", "gauge", "1 while it asks after a suspension if it is active"),
        ("epoch", "epoch", "gauge", "Epoch of the assignments it follows"),
        ("written", "written_items", "counter", "Items written"),
        ("unpublished", "unpublished_items", "counter", "Best-effort items lost without a connection"),
        ("unwanted", "unwanted_items", "counter", "Items not published because nobody wants them"),
        (
            "refused",
            "refused_items",
            "counter",
            "Items refused: another instance is active, or there was no room to hold them until that is known",
        ),
        ("held_for_permission", "held_items", "counter", "Items held until the handshake ended"),
        ("replaced", "replaced_items", "counter", "Items replaced by newer ones under pacing"),
        ("key_writers", "key_writers", "gauge", "Keys that are being written"),
        ("updates.connected", "updates_connected", "gauge", "1 while Data Updates can be written to"),
        ("updates.refused", "updates_refused_messages", "counter", "Messages the server refused"),
        ("updates.lost_disconnected", "updates_lost_messages", "counter", "Messages lost on disconnection"),
        ("updates.reconnects", "updates_reconnects", "counter", "Reconnections of the sender"),
        ("updates.held_back", "updates_held_back_writes", "counter", "Writes that waited for readers"),
        ("updates.resent", "updates_resent_messages", "counter", "Messages resent after a restart"),
        ("updates.kept_bytes", "updates_kept_bytes", "gauge", "Bytes kept until readers acknowledge"),
        ("receiving.received", "received_items", "counter", "Items received"),
        ("receiving.gaps", "missing_items", "counter", "Items missing according to their sequence numbers"),
        ("receiving.repeats", "repeated_items", "counter", "Repeated items that were dropped"),
        ("receiving.fenced", "fenced_items", "counter", "Items of a replaced instance, dropped"),
        ("receiving.undecodable", "undecodable_frames", "counter", "Frames that could not be read"),
        ("receiving.newer_version", "newer_version_frames", "counter", "Frames of a newer version"),
        ("receiving.misplaced", "misplaced_frames", "counter", "Frames of another key than their channel's"),
        ("receiving.foreign", "foreign_frames", "counter", "Frames of another app than their key's"),
        ("receiving.out_of_range", "out_of_range_frames", "counter", "Frames with impossible numbers"),
        ("receiving.refuted", "refuted_frames", "counter", "Numbers that later frames showed to be false"),
        ("receiving.callback_errors", "callback_errors", "counter", "Exceptions raised by callbacks"),
        ("receiving.set_aside", "set_aside_items", "counter", "Items set aside: callbacks kept failing"),
        (
            "receiving.set_aside_waiting",
            "set_aside_waiting",
            "gauge",
            "Set-aside payloads that wait for Data Updates",
        ),
        (
            "receiving.set_aside_lost",
            "set_aside_lost",
            "counter",
            "Payloads that could be neither handled nor set aside",
        ),
        (
            "receiving.dropped_slow",
            "dropped_slow_frames",
            "counter",
            "Frames dropped because a callback was slow",
        ),
        ("receiving.reconnects", "receiver_reconnects", "counter", "Reconnections of the receiver"),
        ("receiving.claimed", "claimed_frames", "counter", "Frames taken over from dead members"),
        ("misunderstood_assignments", "refused_assignments", "counter", "Assignments that were refused"),
        (
            "liveness.dispatcher_s",
            "dispatcher_silent_seconds",
            "gauge",
            "Seconds since the dispatcher's last answer",
        ),
        (
            "liveness.heartbeat_s",
            "heartbeat_silent_seconds",
            "gauge",
            "Seconds since the heartbeat thread's last loop",
        ),
        ("liveness.archiver_s", "archiver_silent_seconds", "gauge", "Seconds since the archiver's last loop"),
        ("archive.archived", "archived_items", "counter", "Items archived"),
        ("archive.spooled", "spooled_items", "counter", "Items spooled while the archive was not reachable"),
        ("archive.lost", "archive_lost_items", "counter", "Items lost: neither archived nor spooled"),
        ("archive.refused", "archive_refused_items", "counter", "Items the archive refused for good"),
        ("archive.held_back", "archive_held_back_writes", "counter", "Waits for the archive's queue"),
        ("archive.backlog", "archive_backlog_frames", "gauge", "Frames not yet archived"),
        (
            "damaged_rows",
            "archive_damaged_rows",
            "counter",
            "Damaged rows left out of answers of the archive",
        ),
        ("archive.damaged_spools", "damaged_spools", "counter", "Damaged spools and records set aside"),
        ("archive.away", "archive_away", "gauge", "1 while the archive cannot be reached"),
    )
}


def render(app: str, engine: Mapping[str, Any], health: Mapping[str, Any]) -> str:
    """The health of an engine and its service in Prometheus' text format."""
    instance = str(engine.get("instance", ""))
    lines = list(_engine_lines(engine, {"app": app, "instance": instance}))
    phase = {"app": app, "instance": instance, "phase": str(engine.get("phase", ""))}
    lines += [
        "# HELP due_phase How far the handshake is",
        "# TYPE due_phase gauge",
        _line("due_phase", phase, 1),
    ]
    lines += _app_lines(app, health, instance)
    return "\n".join(lines) + "\n"


def _engine_lines(engine: Mapping[str, Any], labels: Mapping[str, str]) -> Iterator[str]:
    for path, family in _ENGINE.items():
        value: Any = engine
        for part in path.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        if isinstance(value, bool | int | float):
            yield f"# HELP {family.name} {family.text}"
            yield f"# TYPE {family.name} {family.kind}"
            yield _line(family.name, labels, value)


def _app_lines(app: str, health: Mapping[str, Any], instance: str) -> list[str]:
    families: dict[str, list[str]] = {}
    for path, more, value in _numbers(health, (), {}):
        name = _metric_name((app, *path))
        families.setdefault(name, []).append(_line(name, {"instance": instance, **more}, value))
    return [line for name, samples in families.items() for line in (f"# TYPE {name} untyped", *samples)]


def _numbers(
    value: Any, path: tuple[str, ...], labels: Mapping[str, str]
) -> Iterator[tuple[tuple[str, ...], Mapping[str, str], float]]:
    if isinstance(value, bool | int | float):
        yield path, labels, value
    elif isinstance(value, Mapping):
        for name, part in value.items():
            yield from _numbers(part, (*path, str(name)), labels)
    elif isinstance(value, list | tuple):
        if not all(isinstance(one, Mapping) for one in value):
            yield path, labels, len(value)
            return
        for number, one in enumerate(value):
            yield from _numbers(one, path, {**labels, **_label(one, number)})


def _label(one: Mapping[str, Any], number: int) -> dict[str, str]:
    found = next((str(one[name]) for name in _NAMES if isinstance(one.get(name), str)), None)
    return {"name": found} if found is not None else {"index": str(number)}


def _metric_name(parts: tuple[str, ...]) -> str:
    name = re.sub(r"[^a-zA-Z0-9_]", "_", "_".join(parts))
    head, _, unit = name.rpartition("_")
    name = f"{head}_{_UNITS[unit]}" if head and unit in _UNITS else name
    return name if not name[:1].isdigit() else f"_{name}"


def _line(name: str, labels: Mapping[str, str], value: float) -> str:
    inside = ",".join(f'{label}="{_escaped(text)}"' for label, text in labels.items())
    return f"{name}{{{inside}}} {_number(value)}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def _number(value: float) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "+Inf" if value > 0 else "-Inf"
    return repr(int(value)) if isinstance(value, bool | int) else repr(value)
