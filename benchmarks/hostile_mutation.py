"""Seeded mutation of genuine inputs: of their bytes, and of the structure that they encode.

    genuine input ──► bits, splices, truncation, interesting integers          every form
                 └──► a field exchanged, dropped or doubled in the tree         values of DUE, JSON
                 └──► fields of a message moved, repeated or overlong           protobuf
                 └──► cells and lines exchanged                                 text

The same numbers make the same input again: a finding needs no more than target, seed and index.
"""

import json
import math
import random
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from due.codec import decode_value, encode_value
from due.errors import DecodeError, UnsupportedValue
from due.messages import RecordBatch

Mutate = Callable[[random.Random, Sequence[bytes]], bytes]

LARGEST = 1 << 17
"""Bytes of a mutated input, or twice the largest genuine one."""
_INTEGERS = (
    *(0, 1, -1, 2, 7, 8, 127, 128, 255, 256, 32_767, 32_768, 65_535, 65_536, 1_000_000),
    *(
        2**31 - 1,
        2**31,
        -(2**31),
        2**32 - 1,
        2**32,
        2**48,
        2**62,
        2**62 + 1,
        2**63 - 1,
        2**63,
        -(2**63),
        2**64 - 1,
    ),
)
_TEXTS = (
    "",
    "0",
    "-1",
    "\x00",
    "\n",
    "١٢",
    "\u202e",
    "x" * 300,
    "10.0.0.1/33",
    "fe80::1%1",
    "a.*",
    "**",
    "nan",
    "1e999",
)
_WORDS = b"0123456789.,:;=()[]{}<>\"'\\/*|&!-+_ \t\n\r#%$@^~?xeE\x00\xff"
_KINDS = ("f8", "u1", "i8", "u8", "M8[ns]", "S3", "?", "c16", ">i4", "U2", "V4")
_MOST_CHANGES = 4
_MOST_PARTS = 200_000
"""Of a mutated tree."""
_DEPTH = 4


def mutate_bytes(chance: random.Random, seeds: Sequence[bytes]) -> bytes:
    """A few changes of any bytes, lengths and integers in them."""
    data = bytearray(chance.choice(seeds))
    for _ in range(chance.randint(1, _MOST_CHANGES)):
        chance.choice(_CHANGES)(chance, data, seeds)
    return bytes(data[: _limit(seeds)])


def _limit(seeds: Sequence[bytes]) -> int:
    return max(LARGEST, *(2 * len(seed) for seed in seeds))


def _flip(chance: random.Random, data: bytearray, _seeds: Sequence[bytes]) -> None:
    if data:
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)


def _replace(chance: random.Random, data: bytearray, _seeds: Sequence[bytes]) -> None:
    if data:
        data[chance.randrange(len(data))] = chance.choice((0, 1, 0x7F, 0x80, 0xFF, chance.randrange(256)))


def _cut(chance: random.Random, data: bytearray, _seeds: Sequence[bytes]) -> None:
    if chance.random() < 0.3:
        del data[chance.randint(0, len(data)) :]
    else:
        at = chance.randint(0, len(data))
        del data[at : at + chance.randint(1, 8)]


def _insert(chance: random.Random, data: bytearray, _seeds: Sequence[bytes]) -> None:
    at = chance.randint(0, len(data))
    data[at:at] = chance.randbytes(chance.choice((1, 1, 2, 4, 8, 64)))


def _repeat(chance: random.Random, data: bytearray, _seeds: Sequence[bytes]) -> None:
    at = chance.randint(0, len(data))
    piece = data[at : at + chance.randint(1, 64)]
    data[at:at] = piece * chance.choice((1, 1, 2, 16))


def _splice(chance: random.Random, data: bytearray, seeds: Sequence[bytes]) -> None:
    other = chance.choice(seeds)
    begin, at = chance.randint(0, len(other)), chance.randint(0, len(data))
    size = chance.randint(0, 256)
    data[at : at + chance.choice((0, size))] = other[begin : begin + size]


def _integer(chance: random.Random, data: bytearray, _seeds: Sequence[bytes]) -> None:
    width = chance.choice((2, 4, 8))
    number = chance.choice(_INTEGERS) & ((1 << 8 * width) - 1)
    at = chance.randint(0, max(0, len(data) - width))
    data[at : at + width] = number.to_bytes(width, chance.choice(("big", "little")))


_CHANGES = (_flip, _flip, _replace, _replace, _cut, _insert, _repeat, _splice, _integer)


def mutate_text(chance: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Characters, numbers and lines exchanged; now and then any bytes."""
    if chance.random() < 0.2:
        return mutate_bytes(chance, seeds)
    data = bytearray(chance.choice(seeds))
    for _ in range(chance.randint(1, _MOST_CHANGES)):
        at = chance.randint(0, len(data))
        what = chance.randrange(5)
        if what == 0:
            data[at : at + chance.randint(0, 3)] = bytes((chance.choice(_WORDS),))
        elif what == 1:
            data[at : at + chance.randint(0, 6)] = str(chance.choice(_INTEGERS)).encode()
        elif what == 2:
            data[at : at + chance.randint(0, 3)] = chance.choice(_TEXTS).encode()
        elif what == 3:
            data[at:at] = bytes((chance.choice(_WORDS),)) * chance.choice((1, 2, 50, 3_000))
        else:
            chance.choice((_lines, _splice, _cut))(chance, data, seeds)
    return bytes(data[: _limit(seeds)])


def _lines(chance: random.Random, data: bytearray, _seeds: Sequence[bytes]) -> None:
    lines: list[bytes | bytearray] = [*data.splitlines(keepends=True)] or [b""]
    first, second = chance.randrange(len(lines)), chance.randrange(len(lines))
    chance.choice((_swap, _double, _drop))(lines, first, second)
    data[:] = b"".join(lines)


def _swap(lines: list[Any], first: int, second: int) -> None:
    lines[first], lines[second] = lines[second], lines[first]


def _double(lines: list[Any], first: int, second: int) -> None:
    lines.insert(first, lines[second])


def _drop(lines: list[Any], first: int, _second: int) -> None:
    del lines[first]


def mutate_json(chance: random.Random, seeds: Sequence[bytes]) -> bytes:
    """A tree of JSON with some of its values exchanged; a quarter of the inputs as text."""
    if chance.random() < 0.25:
        return mutate_text(chance, seeds)
    tree = json.loads(chance.choice(seeds))
    for _ in range(chance.randint(1, _MOST_CHANGES)):
        tree = changed(chance, tree, _json_atom)
    if _grown(tree):
        return mutate_bytes(chance, seeds)
    return json.dumps(tree).encode("utf-8", "surrogatepass")[: _limit(seeds)]


def mutate_value(chance: random.Random, seeds: Sequence[bytes]) -> bytes:
    """A value of DUE with some of its parts exchanged; a fifth of the inputs as bytes."""
    if chance.random() < 0.2:
        return mutate_bytes(chance, seeds)
    value = decode_value(chance.choice(seeds))
    try:
        for _ in range(chance.randint(1, _MOST_CHANGES)):
            value = changed(chance, value, _due_atom)
        if _grown(value):
            return mutate_bytes(chance, seeds)
        return encode_value(value)
    except (UnsupportedValue, DecodeError, OverflowError, ValueError, TypeError):
        return mutate_bytes(chance, seeds)  # not every tree is a value


def _grown(tree: Any) -> bool:
    """Whether repeated doubling has made more of a tree than any decoder would be sent: encoding it takes minutes."""
    left, waiting = _MOST_PARTS, [tree]
    while waiting and left > 0:
        part = waiting.pop()
        if isinstance(part, dict | list):
            left -= len(part)
            waiting.extend(part.values() if isinstance(part, dict) else part)
    return left <= 0


def changed(chance: random.Random, tree: Any, atom: Callable[[random.Random], Any]) -> Any:
    """The tree with one part exchanged, dropped or doubled, somewhere in it."""
    if isinstance(tree, RecordBatch):
        return _changed_batch(chance, tree)
    if isinstance(tree, dict) and tree and chance.random() < 0.9:
        return _changed_map(chance, tree, atom)
    if isinstance(tree, list) and tree and chance.random() < 0.9:
        return _changed_list(chance, tree, atom)
    if isinstance(tree, str) and chance.random() < 0.5:
        at = chance.randint(0, len(tree))
        return (
            tree[:at]
            + chance.choice((*_TEXTS, chr(chance.choice(_WORDS))))
            + tree[at + chance.randint(0, 2) :]
        )
    if isinstance(tree, np.ndarray) and chance.random() < 0.8:
        return _changed_column(chance, tree)
    if type(tree) is int and chance.random() < 0.5:
        return tree + chance.choice((-1, 1, 2**8, 2**32))
    return atom(chance)


def _changed_map(chance: random.Random, tree: dict[Any, Any], atom: Callable[[random.Random], Any]) -> Any:
    made, name = dict(tree), chance.choice(list(tree))
    what = chance.random()
    if what < 0.1:
        del made[name]
    elif what < 0.15:
        made[f"{name}{chance.choice(_TEXTS)}"] = atom(chance)
    elif what < 0.25:
        made[name] = atom(chance)
    elif what < 0.3:
        made[name] = tree[chance.choice(list(tree))]
    else:
        made[name] = changed(chance, tree[name], atom)
    return made


def _changed_list(chance: random.Random, tree: list[Any], atom: Callable[[random.Random], Any]) -> Any:
    made, at = list(tree), chance.randrange(len(tree))
    what = chance.random()
    if what < 0.1:
        del made[at]
    elif what < 0.2:
        made[at:at] = [made[at]] * chance.choice((1, 2, 100))
    elif what < 0.3:
        made[at] = atom(chance)
    else:
        made[at] = changed(chance, made[at], atom)
    return made


def _changed_batch(chance: random.Random, batch: RecordBatch) -> Any:
    columns = dict(batch)
    name = chance.choice(list(columns) or ["time_us"])
    what = chance.random()
    if what < 0.1:
        columns.pop(name, None)
    elif what < 0.15:
        return columns
    elif what < 0.2:
        columns[name + chance.choice(_TEXTS)] = np.zeros(len(batch))
    elif what < 0.3:
        rows = np.array(
            [chance.randrange(len(batch)) for _ in range(chance.choice((0, 1, 3, 300)))] if batch else []
        )
        return batch.take(rows.astype(np.intp))
    elif name in columns:
        columns[name] = _changed_column(chance, columns[name])
    return RecordBatch(columns)


def _changed_column(chance: random.Random, column: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    what = chance.random()
    if what < 0.3:
        return np.ones(column.shape, "i8").astype(chance.choice(_KINDS))
    if what < 0.4:
        return np.resize(column, chance.choice((0, 1, 7)))
    if column.dtype.kind not in "iuf" or not column.size:
        return np.frombuffer(chance.randbytes(column.nbytes), "u1").copy()
    made = column.copy()
    flat = made.reshape(-1)
    for _ in range(chance.randint(1, 3)):
        at = chance.randrange(flat.size)
        if column.dtype.kind == "f":
            flat[at] = chance.choice((math.nan, math.inf, -math.inf, -1.0, 1e300))
        else:
            width = column.dtype.itemsize
            number = chance.choice(_INTEGERS) & ((1 << 8 * width) - 1)
            flat[at : at + 1].view(f"u{width}")[0] = number
    return made


def _json_atom(chance: random.Random) -> Any:
    what = chance.randrange(6)
    if what == 0:
        return chance.choice(_TEXTS)
    if what == 1:
        return chance.choice((None, True, False, 0.5, -0.0, 1e300))
    if what == 2:
        return chance.choice(([], {}, [[]], {"": None}, [0] * 50))
    if what == 3:
        return nested(chance.choice((3, 20, 150)))
    return chance.choice(_INTEGERS)


def _due_atom(chance: random.Random) -> Any:
    if chance.random() < 0.7:
        return _json_atom(chance)
    return chance.choice(
        (
            b"",
            b"\xff" * 99,
            np.array(5),
            np.ones(3, ">u4"),
            np.zeros((2, 2)),
            np.array([math.nan]),
            math.nan,
            math.inf,
            RecordBatch({}),
            RecordBatch({"time_us": np.array([-(2**63), 2**63 - 1])}),
        )
    )


def nested(depth: int) -> list[Any]:
    """Lists in lists."""
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


def mutate_protobuf(chance: random.Random, seeds: Sequence[bytes]) -> bytes:
    """A message with fields dropped, doubled, moved, of other numbers or lengths; a third as bytes."""
    if chance.random() < 0.3:
        return mutate_bytes(chance, seeds)
    return _changed_message(chance, chance.choice(seeds), seeds, _DEPTH)


def _changed_message(chance: random.Random, data: bytes, seeds: Sequence[bytes], depth: int) -> bytes:
    fields = message_fields(data)
    if not fields:
        return mutate_bytes(chance, (data, *seeds))
    at = chance.randrange(len(fields))
    what = chance.random()
    if what < 0.08:
        del fields[at]
    elif what < 0.16:
        fields[at:at] = [fields[at]] * chance.choice((1, 2, 20))
    elif what < 0.22:
        chance.shuffle(fields)
    else:
        number, wire, value = fields[at]
        if what < 0.27:
            number = chance.choice((1, 2, 3, 4, 5, 15, 16, 2**29 - 1))
        elif isinstance(value, int):
            value = chance.choice(_INTEGERS) & ((1 << 64) - 1)
        elif depth and value and chance.random() < 0.8:
            value = _changed_message(chance, value, (value,), depth - 1)
        else:
            value = mutate_bytes(chance, (value, *seeds))
        fields[at] = (number, wire, value)
    return b"".join(_field(*field) for field in fields)


Field = tuple[int, int, int | bytes]
"""Number, wire type, value."""


def message_fields(data: bytes) -> list[Field]:
    """The fields of a protobuf message on the wire; empty where it is none."""
    fields: list[Field] = []
    at = 0
    try:
        while at < len(data):
            tag, at = _varint(data, at)
            number, wire = tag >> 3, tag & 7
            value: int | bytes
            if wire == 0:
                value, at = _varint(data, at)
            elif wire in (1, 5, 2):
                size = {1: 8, 5: 4}.get(wire, 0)
                if wire == 2:
                    size, at = _varint(data, at)
                value = data[at : at + size]
                if len(value) != size:
                    return []
                at += size
            else:
                return []
            if not number:
                return []
            fields.append((number, wire, value))
    except IndexError:
        return []
    return fields


def _varint(data: bytes, at: int) -> tuple[int, int]:
    number = shift = 0
    while True:
        byte = data[at]
        at += 1
        number |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80 or shift > 63:
            return number, at


def _varint_bytes(number: int) -> bytes:
    out = bytearray()
    while number >= 0x80:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def _field(number: int, wire: int, value: int | bytes) -> bytes:
    head = _varint_bytes(number << 3 | wire)
    if isinstance(value, int):
        return head + _varint_bytes(value)
    return head + (_varint_bytes(len(value)) if wire == 2 else b"") + value
