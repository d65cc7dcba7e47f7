"""DUE items → the controller's own types, where `Message.from_item` is not all there is to do.  Pure.

Each decoder accepts an item of any origin, and raises `MessageError` only.
"""

from typing import Final

import msgspec
import numpy as np

from apps.intake import as_map
from apps.messages import Message, MessageError, Name, Number, TableCommand, Time, sender_of
from apps.p4runtime_ctrl.telemetry.demand import Offer
from apps.packets import as_column, read_columns
from due import Item, RecordBatch

MOST_FRAMES: Final = 4096
"""Most frames of one item."""
MOST_FRAME_BYTES: Final = 8 << 20
"""Most bytes of all frames of one item."""
MOST_QUESTIONS: Final = 65_536
QUESTION: Final = {
    "id": "u8", "query": "u1", "src_hi": "u8", "src_lo": "u8", "dst_hi": "u8", "dst_lo": "u8", "port": "u2",
    "length": "u2", "time_us": "i8",
}  # fmt: skip
"""Columns of a request for cells."""
OPTIONAL: Final = {"source_port": "u2", "sweep": "u1"}
"""Optional columns; 0 if missing."""


class ClockReached(Message, frozen=True, kw_only=True):
    """`network.clock.<app>.<switch>`: the capture time, ns, that a program which feeds a switch has reached."""

    event_time: Time


class SwitchTold(Message, frozen=True, kw_only=True):
    """What another controller says of a switch in `network.switch.p4runtime_ctrl.<switch>`."""

    switch: Name
    primary: bool = False
    event_time: Time = 0
    sequence: Number = 0


class FramesToSend(msgspec.Struct, frozen=True):
    """Frames that the switch is to send."""

    ports: list[int]
    lengths: list[int]
    data: bytes
    """The frames, concatenated."""


def told_in(item: Item) -> SwitchTold:
    """`network.switch.p4runtime_ctrl.<switch>`: of another instance of this app."""
    sender_of(item)
    told = SwitchTold.from_value(item.value)
    if item.key.rpartition(".")[2] != told.switch:
        raise MessageError("fields", f"{item.key}: its value names switch {told.switch!r}")
    return told


def offer_in(item: Item) -> tuple[str, Offer]:
    """`network.telemetry.<app>.<name>`: the app and its packet request."""
    app = sender_of(item)
    offer = Offer.from_value(item.value)
    if item.key.rpartition(".")[2] != offer.name:
        raise MessageError("fields", f"{item.key}: offers {offer.name!r}, which is not the name in the key")
    return app, offer


def command_and_requests_in(item: Item) -> tuple[TableCommand, str, tuple[Offer, ...]]:
    """`network.p4_command.<app>.<switch>`: the command, the app, and its packet requests."""
    command = TableCommand.from_item(item)
    return command, sender_of(item), tuple(Offer.from_value(value) for value in command.requests)


def questions_in(item: Item) -> RecordBatch:
    """`network.cell_request.<app>.<switch>`: a batch with the columns `QUESTION` and `OPTIONAL`."""
    sender_of(item)
    value = item.value
    kinds = QUESTION | {name: kind for name, kind in OPTIONAL.items() if _has(value, name)}
    found = read_columns(value, kinds, "cell_request")
    if len(found) > MOST_QUESTIONS:
        raise MessageError(
            "size", f"cell_request: {len(found):,} questions; send at most {MOST_QUESTIONS:,} at once"
        )
    none = {name: np.zeros(len(found), kind) for name, kind in OPTIONAL.items() if name not in kinds}
    return RecordBatch({**found, **none})


def _has(value: object, name: str) -> bool:
    return isinstance(value, RecordBatch) and name in value


def frames_in(item: Item) -> FramesToSend:
    """`network.packet_out.<app>.<switch>`: `{"port": [..], "length": [..], "frames": bytes end to end}`."""
    sender_of(item)
    value = item.value
    if type(value) is not dict or not {"port", "length", "frames"} <= value.keys():
        raise MessageError("shape", "packet_out: give a map with port, length and frames")
    ports, lengths = _numbers(value["port"], "port"), _numbers(value["length"], "length")
    data = value["frames"]
    if not isinstance(data, bytes):
        raise MessageError("shape", f"packet_out: frames are concatenated bytes, not {type(data).__name__}")
    if len(ports) > MOST_FRAMES or len(data) > MOST_FRAME_BYTES:
        raise MessageError(
            "size", f"packet_out: {len(ports)} frames of {len(data)} bytes; send fewer at once"
        )
    if len(ports) != len(lengths) or min(lengths, default=1) < 1 or sum(lengths) != len(data):
        raise MessageError(
            "fields",
            f"packet_out: {len(ports)} ports, {len(lengths)} lengths of {sum(lengths)} bytes in all, "
            f"{len(data)} bytes of frames; they must agree",
        )
    return FramesToSend(ports, lengths, data)


def _numbers(value: object, name: str) -> list[int]:
    if isinstance(value, np.ndarray):
        return [int(number) for number in as_column(value, "u4", f"packet_out: {name}").tolist()]
    as_map({name: value}, "packet_out")
    if not isinstance(value, list) or not all(
        type(number) is int and 0 <= number < 1 << 32 for number in value
    ):
        raise MessageError("fields", f"packet_out: {name} is a list of whole numbers")
    return value
