"""What the switch can do with each field of a packet, from what the planner itself accepts."""

from typing import Final

import msgspec

from apps.sonata_adapter.errors import NotPlaced
from apps.sonata_adapter.planner.conditions import conditions_of
from apps.sonata_adapter.planner.placement import by_bytes, masks_of
from apps.sonata_adapter.query.expressions import (
    PACKET_FIELDS,
    PAYLOAD_FIELDS,
    UNITS,
    BinaryOperation,
    Expression,
    Field,
    Kind,
    Number,
    Within,
)

_TYPES: Final[dict[Kind, str]] = {
    "number": "number", "address": "address", "mac": "MAC", "name": "name", "condition": "condition",
}  # fmt: skip


class FieldPlace(msgspec.Struct, frozen=True):
    """A field of the query language."""

    name: str
    type: str
    """number, address, MAC, name or bytes."""
    unit: str
    """Of numbers that have one."""
    switch: tuple[str, ...]
    """What the switch can do with it: filter, key, sum; empty: it is used on the host only."""
    payload: bool
    """Whether the packet's bytes are copied to the host for it, not its headers alone."""
    meaning: str


def field_places() -> list[FieldPlace]:
    """Every field, in the order of `PACKET_FIELDS`, and the payload."""
    found = [
        FieldPlace(
            name, _TYPES[kind], UNITS.get(name, ""), _uses(name, kind), name in PAYLOAD_FIELDS, meaning
        )
        for name, (kind, meaning) in PACKET_FIELDS.items()
    ]
    return [
        *found,
        FieldPlace("payload", "bytes", "", (), True, 'TCP or UDP payload: payload contains "text"'),
    ]


def _uses(name: str, kind: Kind) -> tuple[str, ...]:
    found = []
    if any(conditions_of((probe,)).exact for probe in _probes(name, kind)):
        found.append("filter")
    try:
        masks_of((Field(name),))
        found.append("key")
    except NotPlaced:
        pass
    try:
        by_bytes(Field(name))
        found.append("sum")
    except NotPlaced:
        pass
    return tuple(found)


def _probes(name: str, kind: Kind) -> tuple[Expression, ...]:
    """Comparisons that people write; the classifier knows fields by some of them."""
    field = Field(name)
    if kind == "address":
        return (Within(field, "10.0.0.0/8"),)
    masked = BinaryOperation("&", field, Number(2))
    return (
        BinaryOperation("==", field, Number(4)),
        BinaryOperation("==", masked, Number(2)),
    )
