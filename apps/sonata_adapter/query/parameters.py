"""Parameters of queries: name, unit, default, bounds; from text and back to canonical text."""

import re
from typing import Final, Literal

import msgspec

from apps.sonata_adapter.errors import InvalidRequest, QueryError
from apps.sonata_adapter.query.expressions import canonical_prefix
from apps.sonata_adapter.query.language import MAX_WINDOW_MS, duration_text

Value = int | str
ANY_PREFIX: Final = "any"
UNREFINED: Final = "none"

_DURATION: Final = re.compile(r"([0-9]{1,9})(ms|s|m|h)")
_UNITS_MS: Final = {"ms": 1, "s": 1000, "m": 60_000, "h": 3_600_000}
_LEVELS: Final = re.compile(r"[0-9]{1,2}(/[0-9]{1,2})*")
_ADDRESS_BITS: Final = 32
_MOST_LEVELS: Final = 4
"""Each takes one or two of the switch's counting stages."""


class Parameter(msgspec.Struct, frozen=True, kw_only=True):
    """One parameter.

    Durations are milliseconds inside, `3s` in text; prefixes are text or `any`, levels `8/16/32` or `none`.
    """

    name: str
    kind: Literal["number", "duration", "prefix", "levels"]
    default: Value
    low: int = 0
    high: int = 0
    unit: str = ""
    meaning: str

    def parse(self, text: str) -> Value:
        """The value of a text; raises `InvalidRequest`, which says what is accepted."""
        if self.kind == "prefix":
            return self._prefix(text)
        if self.kind == "levels":
            return self._levels(text)
        value = self._duration(text) if self.kind == "duration" else self._number(text)
        if not self.low <= value <= self.high:
            raise InvalidRequest(f"{self.name}={text} is out of bounds; give {self.bounds}")
        return value

    def text(self, value: Value) -> str:
        """The canonical spelling of a value."""
        return duration_text(int(value)) if self.kind == "duration" else str(value)

    @property
    def bounds(self) -> str:
        """The accepted values, as text."""
        if self.kind == "prefix":
            return "an address, a prefix such as 10.0.0.0/8, or any"
        if self.kind == "levels":
            return "none, or up to three rising lengths of IPv4 prefixes below 32, such as 16 or 8/16"
        low, high = self.text(self.low), self.text(self.high)
        or_auto = ", or auto" if self.name == "threshold" and self.kind == "number" else ""
        return f"{low} to {high}" + (f" {self.unit}" if self.unit else "") + or_auto

    def _number(self, text: str) -> int:
        if not re.fullmatch(r"[0-9]{1,18}", text):
            raise InvalidRequest(f"{self.name}={text} is not a whole number; give {self.bounds}")
        return int(text)

    def _duration(self, text: str) -> int:
        found = _DURATION.fullmatch(text)
        if found is None:
            raise InvalidRequest(
                f"{self.name}={text} is not a duration; write 500ms, 3s or 1m, {self.bounds}"
            )
        return int(found[1]) * _UNITS_MS[found[2]]

    def _prefix(self, text: str) -> str:
        if text == ANY_PREFIX:
            return text
        try:
            prefix = canonical_prefix(text)
        except QueryError as error:
            raise InvalidRequest(f"{self.name}={text}: {error}") from None
        address, _, bits = prefix.partition("/")
        whole = bits == ("128" if ":" in address else "32")
        return address if whole else prefix

    def _levels(self, text: str) -> str:
        if text == UNREFINED:
            return text
        bits = [int(part) for part in text.split("/")] if _LEVELS.fullmatch(text) else []
        if bits and bits[-1] < _ADDRESS_BITS:
            bits.append(_ADDRESS_BITS)
        rising = bits == sorted(set(bits)) and all(0 < each <= _ADDRESS_BITS for each in bits)
        if not rising or not 1 < len(bits) <= _MOST_LEVELS:
            raise InvalidRequest(f"{self.name}={text} is not a list of levels; give {self.bounds}")
        return "/".join(map(str, bits))


def window(default_ms: int) -> Parameter:
    """The window of a query."""
    return Parameter(
        name="window",
        kind="duration",
        default=default_ms,
        low=100,
        high=MAX_WINDOW_MS,
        meaning="results are for windows [n·W, (n+1)·W) of capture time",
    )


def number(name: str, default: int, meaning: str, *, unit: str = "", high: int = 1_000_000_000) -> Parameter:
    """A whole number from 1."""
    return Parameter(name=name, kind="number", default=default, low=1, high=high, unit=unit, meaning=meaning)


def prefix(name: str, meaning: str) -> Parameter:
    """An address or prefix; any by default."""
    return Parameter(name=name, kind="prefix", default=ANY_PREFIX, meaning=meaning)


def levels() -> Parameter:
    """Levels of iterative refinement; none by default."""
    return Parameter(
        name="refine",
        kind="levels",
        default=UNREFINED,
        meaning="count prefixes of these lengths first (IPv6: four times as long), addresses only below those that crossed",
    )
