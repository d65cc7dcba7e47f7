"""Templates of NetFlow v9 (RFC 3954) and IPFIX (RFC 7011): which field stands where in a record."""

import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

from flow_records.decoding.errors import FlowDecodeError

VARIABLE: Final = 0xFFFF
"""Width of a field that says its length itself; IPFIX only."""
UNKNOWN: Final = -1
"""Element of fields that are stepped over: those of enterprises, and NetFlow v9's scopes."""
MOST_FIELDS: Final = 256
MOST_TEMPLATES: Final = 256
_LEAST_ID: Final = 256
_PAIR: Final = struct.Struct("!HH")
_ENTERPRISE: Final = 0x8000


class TemplateField(NamedTuple):
    """One field of a record."""

    element: int
    """Its number in IANA's list of IPFIX elements, or UNKNOWN."""
    width: int
    """Bytes, or VARIABLE."""


class FlowTemplate:
    """What records of one set look like.

    Args:
        number: its id, which is the id of the sets that use it.
        fields: in the order of the record.
        options: whether the records tell about the exporter, not about flows.
    """

    def __init__(self, number: int, fields: tuple[TemplateField, ...], *, options: bool) -> None:
        self.number = number
        self.fields = fields
        self.options = options
        self.variable = any(field.width == VARIABLE for field in fields)
        self.least = sum(1 if field.width == VARIABLE else field.width for field in fields)
        """Bytes of the shortest record."""
        self.known: dict[int, int] = {}
        """Element to its place among the fields; of several the first."""
        for place, field in enumerate(fields):
            if field.element != UNKNOWN:
                self.known.setdefault(field.element, place)


class TemplateCache:
    """The templates of one exporter's domain; they expire when the exporter does not repeat them.

    Args:
        lifetime_s: seconds after which a template is forgotten.
    """

    def __init__(self, lifetime_s: float) -> None:
        self._lifetime_s = lifetime_s
        self._known: dict[int, tuple[FlowTemplate, float]] = {}

    def __len__(self) -> int:
        return len(self._known)

    def put(self, template: FlowTemplate, now: float) -> None:
        """Keep a template, in place of one with the same id.

        Raises:
            FlowDecodeError: MOST_TEMPLATES are known already.
        """
        if template.number not in self._known and len(self._known) >= MOST_TEMPLATES:
            self._expire(now)
            if len(self._known) >= MOST_TEMPLATES:
                raise FlowDecodeError("limit", f"over {MOST_TEMPLATES} templates of one exporter and domain")
        self._known[template.number] = (template, now)

    def get(self, number: int, now: float) -> FlowTemplate | None:
        """The template of this id; None if it never came or has expired."""
        template, told = self._known.get(number, (None, now))
        if now - told > self._lifetime_s:
            del self._known[number]
            return None
        return template

    def _expire(self, now: float) -> None:
        old = [number for number, (_, told) in self._known.items() if now - told > self._lifetime_s]
        for number in old:
            del self._known[number]


def netflow9_templates(body: bytes) -> Iterator[FlowTemplate]:
    """The templates of a template flow set; raises FlowDecodeError."""
    for number, _, fields in _plain_templates(body, enterprises=False):
        yield _template(number, fields, options=False)


def netflow9_options(body: bytes) -> Iterator[FlowTemplate]:
    """The templates of an options template flow set; raises FlowDecodeError."""
    at = 0
    while len(body) - at >= 6:
        number, scopes, options = struct.unpack_from("!HHH", body, at)
        if _is_padding(number, body, at):
            return
        if scopes % 4 or options % 4:
            raise FlowDecodeError(
                "template", f"options template {number}: {scopes} + {options} bytes of fields"
            )
        fields, at = _fields(body, at + 6, (scopes + options) // 4, enterprises=False)
        # scopes have numbers of their own: 1 is the system there, and the bytes of a flow elsewhere
        scope = [TemplateField(UNKNOWN, field.width) for field in fields[: scopes // 4]]
        yield _template(number, (*scope, *fields[scopes // 4 :]), options=True)


def ipfix_templates(body: bytes) -> Iterator[FlowTemplate]:
    """The templates of a template set; withdrawals are void over UDP (RFC 7011, 8.4).  Raises FlowDecodeError."""
    for number, count, fields in _plain_templates(body, enterprises=True):
        if count:
            yield _template(number, fields, options=False)


def _plain_templates(
    body: bytes, *, enterprises: bool
) -> Iterator[tuple[int, int, tuple[TemplateField, ...]]]:
    """Number, number of fields, and fields of each template that has no scopes."""
    at = 0
    while len(body) - at >= _PAIR.size:
        number, count = _PAIR.unpack_from(body, at)
        if _is_padding(number, body, at):
            return
        fields, at = _fields(body, at + _PAIR.size, count, enterprises=enterprises)
        yield number, count, fields


def ipfix_options(body: bytes) -> Iterator[FlowTemplate]:
    """The templates of an options template set; withdrawals as above.  Raises FlowDecodeError."""
    at = 0
    while len(body) - at >= _PAIR.size:
        number, count = _PAIR.unpack_from(body, at)
        if _is_padding(number, body, at):
            return
        if not count:
            at += _PAIR.size
            continue
        if len(body) - at < 6:
            raise FlowDecodeError("short", f"options template {number}: it ends within its head")
        (scopes,) = struct.unpack_from("!H", body, at + 4)
        if not 1 <= scopes <= count:
            raise FlowDecodeError(
                "template", f"options template {number}: {scopes} of {count} fields are scopes"
            )
        fields, at = _fields(body, at + 6, count, enterprises=True)
        yield _template(number, fields, options=True)


def _is_padding(number: int, body: bytes, at: int) -> bool:
    if number >= _LEAST_ID:
        return False
    if not any(body[at:]):
        return True
    raise FlowDecodeError("template", f"template {number}: ids begin at {_LEAST_ID}")


def _fields(body: bytes, at: int, count: int, *, enterprises: bool) -> tuple[tuple[TemplateField, ...], int]:
    """So many field specifiers, and where they end."""
    if count > MOST_FIELDS:
        raise FlowDecodeError("limit", f"a template of {count} fields; {MOST_FIELDS} at most")
    fields: list[TemplateField] = []
    for _ in range(count):
        if len(body) - at < _PAIR.size:
            raise FlowDecodeError("short", f"a template ends after {len(fields)} of {count} fields")
        element, width = _PAIR.unpack_from(body, at)
        at += _PAIR.size
        if enterprises and element & _ENTERPRISE:
            if len(body) - at < 4:
                raise FlowDecodeError("short", "a template ends within an enterprise number")
            at += 4
            element = UNKNOWN
        if not width:
            # would be for free: a record of many such fields costs time, but no bytes
            raise FlowDecodeError("template", f"a field of width 0 (element {element})")
        if width == VARIABLE and not enterprises:
            raise FlowDecodeError("template", "NetFlow v9 has no fields of variable length")
        fields.append(TemplateField(element, width))
    return tuple(fields), at


def _template(number: int, fields: tuple[TemplateField, ...], *, options: bool) -> FlowTemplate:
    if not fields:
        raise FlowDecodeError("template", f"template {number} has no fields")
    return FlowTemplate(number, fields, options=options)
