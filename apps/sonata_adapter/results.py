"""Results of queries."""

from typing import Any, Final

import msgspec

from due import RecordBatch

TOO_LARGE: Final = "counts too large by up to"
"""In `QueryResult.error` of those that may be."""


class QueryResult(msgspec.Struct, frozen=True, kw_only=True):
    """One tuple that a query reports."""

    query: str
    """The name under which the query was added."""
    window_us: int
    """Start of the window, capture time in us."""
    length_us: int
    at_us: int
    """When the threshold was reached, us; the window's end if it is only known then."""
    fields: dict[str, int | str]
    exact: bool = True
    partial: bool = False
    """The query came into force within the window and has not seen all of it."""
    error: str = ""
    """Why it is an estimate, and its error; empty if it is exact."""

    @property
    def may_be_too_large(self) -> bool:
        """Whether the count is an estimate that may lie above the truth; others lie below."""
        return TOO_LARGE in self.error

    def to_value(self) -> dict[str, Any]:
        """The result as a DUE value; times in ns."""
        value: dict[str, Any] = {
            **self.fields,
            "window_start": self.window_us * 1000,
            "window_end": (self.window_us + self.length_us) * 1000,
            "at": self.at_us * 1000,
            "exact": self.exact,
            "partial": self.partial,
        }
        if self.error:
            value["error"] = self.error
        return value


class Captured(msgspec.Struct, frozen=True, kw_only=True):
    """Packets or tuples that a raw stream reports on arrival."""

    query: str
    batch: RecordBatch
    last_us: int


class Handshake(msgspec.Struct, frozen=True, kw_only=True):
    """A completed TCP handshake: the client is reachable at its address."""

    source: str
    service: str
    port: int
    at_us: int

    def to_value(self) -> dict[str, Any]:
        """The handshake as a DUE value; time in ns."""
        return {"source": self.source, "service": self.service, "port": self.port, "at": self.at_us * 1000}


Output = QueryResult | Captured | Handshake
