"""Decoders for the items that the adapter receives, one for each kind of message.  Pure.

Each takes an untrusted item and raises `MessageError` and nothing else.
"""

from typing import Annotated, Any, Final

import numpy as np
from msgspec import Meta

from apps.evidence import TrainingState
from apps.messages import LATEST_NS, Message, MessageError, Name, TableCommand, Time, sender_of
from apps.packets import PACKET_COLUMNS, as_column, read_columns, read_frames
from apps.sonata_adapter.evidence.count_baseline import CountBaseline
from due import Item, RecordBatch

MOST_FRAMES: Final = 65_536
"""Most frames of one item."""
MOST_FRAME_BYTES: Final = 64 << 20
"""Most bytes of the frames of one item."""
WIDTH: Final = 256
"""Bytes of a frame that queries can read."""
_NUMBERS: Final = {
    "lengths": "u4", "times_us": "i8", "ports": "u2", "sequence": "u8", "arrival": "u8",
}  # fmt: skip
_REPORTED: Final = {**PACKET_COLUMNS, "crossed": "u1", "overflow": "u1"}
_COUNTED: Final = {
    "window": "u4", "count": "i8", "src_hi": "u8", "src_lo": "u8", "dst_hi": "u8", "dst_lo": "u8", "port": "u2",
    "length": "u2", "source_port": "u2", "time_us": "i8",
}  # fmt: skip
_CELLS: Final = {"id": "u8", "count": "u4"}
_COUNTERS: Final = {"bit": "u1", "packets": "u8"}
_KINDS: Final = {"packets": PACKET_COLUMNS, "digests": _REPORTED, "counts": _COUNTED}


class SwitchPrograms(Message, frozen=True, kw_only=True):
    """The fields of `network.switch.p4runtime_ctrl.<switch>` that the adapter reads."""

    base_us: Annotated[int, Meta(ge=0, le=LATEST_NS // 1000)] | None = None
    primary: bool = False
    event_time: Time = 0
    switch: Name = ""


def state_in(item: Item) -> SwitchPrograms:
    """The state of a switch."""
    sender_of(item)
    state = SwitchPrograms.from_value(item.value)
    if state.switch not in ("", item.key.rpartition(".")[2]):
        raise MessageError("fields", f"{item.key}: claims to be from switch {state.switch!r}")
    return state


command_in = TableCommand.from_item
"""An archived command of this app."""
training_in = TrainingState.from_item
"""`network.training.<app>`."""
baseline_in = CountBaseline.from_item
"""An archived baseline of this app."""


def data_in(item: Item) -> RecordBatch:
    """`network.packets|frames|digests|counts.p4runtime_ctrl.<switch>.<query>`."""
    sender_of(item)
    kind = item.key.split(".")[1]
    if kind == "frames":
        return with_frames(item.value)
    return read_columns(item.value, _KINDS[kind], kind)


def cells_in(item: Item) -> tuple[list[int], list[int]]:
    """`network.cell.p4runtime_ctrl.<switch>`: the numbers of questions, and their counts."""
    sender_of(item)
    cells = read_columns(item.value, _CELLS, "cells")
    return cells["id"].tolist(), cells["count"].tolist()


def counters_in(item: Item) -> dict[int, int]:
    """`network.telemetry_counters.p4runtime_ctrl.<switch>`: packets by bit."""
    sender_of(item)
    counters = read_columns(item.value, _COUNTERS, "counters")
    return dict(zip(counters["bit"].tolist(), counters["packets"].tolist(), strict=True))


def with_frames(value: object) -> RecordBatch:
    """The controller's frames as a batch: header columns, frame bytes, and the number of captured bytes.

    Raises `MessageError`.
    """
    if type(value) is not dict or not {"frames", *_NUMBERS} <= value.keys():
        raise MessageError("shape", f"frames: give a map with frames, {', '.join(_NUMBERS)}")
    frames = _frames(value["frames"])
    numbers = {name: as_column(value[name], kind, f"frames: {name}") for name, kind in _NUMBERS.items()}
    if any(len(column) != len(frames) for column in numbers.values()):
        raise MessageError(
            "columns", f"frames: {len(frames)} frames, and other numbers of {', '.join(_NUMBERS)}"
        )
    batch = read_columns(read_frames(frames, **numbers), PACKET_COLUMNS, "frames")
    cut = [frame[:WIDTH] for frame in frames]
    captured = np.array([len(frame) for frame in cut], dtype=np.uint16)
    return RecordBatch({**batch, "frame": np.array(cut, dtype=f"V{WIDTH}"), "captured": captured})


def _frames(value: Any) -> list[bytes]:
    if not isinstance(value, list) or not all(isinstance(frame, bytes) for frame in value):
        raise MessageError("fields", "frames: a list of bytes is expected")
    if len(value) > MOST_FRAMES or sum(map(len, value)) > MOST_FRAME_BYTES:
        raise MessageError("size", f"frames: {len(value):,} frames; send fewer at once")
    return value
