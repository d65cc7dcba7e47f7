"""Updates of bulk writers: thousands that differ in their key's bytes alone.

    first update ── the long way ──► done, and learnt: which of its bytes are values, what the others mean
    later ones   ── same length, same other bytes ──► the key out of the bytes

An update is compared as protobuf writes it, in one step; to ask it for a dozen fields, each an object, costs
several times as much.  A form says nothing that the long way has not said of an update of the same bytes.
"""

from typing import Any, NamedTuple

from dataplane.v1model.tables import Table
from p4rt import p4runtime

_MOST = 64
"""Forms kept; what comes later goes the long way."""
_MOST_BYTES = 1024

Content = tuple[str, tuple[int, ...], int, bytes]
"""Action, parameters, idle time-out in ns, metadata."""


class _Value(NamedTuple):
    """Where a field's value lies, and where it goes in the packed key (keys.py)."""

    from_bit: int
    ones: int
    width: int
    place: int


class Form(NamedTuple):
    """Updates with the same bytes under `mask`."""

    mask: int
    fixed: int
    values: tuple[_Value, ...]
    table: Table
    content: Content | None
    """Of an insertion; None: a deletion."""

    def key(self, update: int) -> int | None:
        """The packed key; None where a value does not fit its field."""
        packed = 0
        for from_bit, ones, width, place in self.values:
            value = update >> from_bit & ones
            if value >> width:
                return None
            packed |= value << place
        return packed


class UpdateForms:
    """The forms of a pipeline's tables, by length."""

    def __init__(self) -> None:
        self._by_length: dict[int, list[Form]] = {}
        self._left = _MOST

    @property
    def is_full(self) -> bool:
        """Whether nothing more will be learnt."""
        return not self._left

    def find(self, update: Any) -> tuple[Form, int] | None:
        """The form of an Update and its packed key; None where it has to be read."""
        data = update.SerializeToString()
        forms = self._by_length.get(len(data))
        if forms is not None:
            number = int.from_bytes(data, "big")
            for form in forms:
                if number & form.mask == form.fixed:
                    key = form.key(number)
                    return None if key is None else (form, key)
        return None

    def learn(self, update: Any, table: Table, content: Content | None) -> None:
        """An update of a table whose key is exact, with its fields in their order, has succeeded.

        To be asked only while it is not full.
        """
        data = update.SerializeToString()
        if len(data) <= _MOST_BYTES:
            self._left -= 1
            form = _form(update, data, table, content)
            self._by_length.setdefault(len(data), []).append(form)


def _form(update: Any, data: bytes, table: Table, content: Content | None) -> Form:
    spots = _spots(update, data)
    mask = (1 << 8 * len(data)) - 1
    values = []
    for (start, size), (spec, place) in zip(spots, table.key.fields, strict=True):
        from_bit, ones = 8 * (len(data) - start - size), (1 << 8 * size) - 1
        mask &= ~(ones << from_bit)
        values.append(_Value(from_bit, ones, spec.width, place))
    return Form(mask, int.from_bytes(data, "big") & mask, tuple(values), table, content)


def _spots(update: Any, data: bytes) -> list[tuple[int, int]]:
    """Start and size of each key field's value: the bytes that change when it does."""
    found = []
    for place in range(len(update.entity.table_entry.match)):
        twin = p4runtime.Update()
        twin.CopyFrom(update)
        field = twin.entity.table_entry.match[place].exact
        field.value = bytes(byte ^ 0xFF for byte in field.value)
        other = twin.SerializeToString()
        start = next(at for at, byte in enumerate(data) if other[at] != byte)
        found.append((start, len(field.value)))
    return found
