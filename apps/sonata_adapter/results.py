"""What queries report."""

from typing import Any

import msgspec

from due import RecordBatch


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """One tuple that a query reports."""

    query: str
    """The name under which the query was added."""
    window_us: int
    """Begin of the window, capture time in us."""
    length_us: int
    at_us: int
    """When the threshold was reached; the window's end for what is known only then."""
    fields: dict[str, int | str]
    exact: bool = True
    partial: bool = False
    """The query came into force within the window and has not seen all of it."""
    error: str = ""
    """Why it is an estimate, and how good."""

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
    """Packets or tuples that a raw stream reports as they come."""

    query: str
    batch: RecordBatch
    last_us: int


class Handshake(msgspec.Struct, frozen=True, kw_only=True):
    """A client proved to a service that it can be reached under its address."""

    source: str
    service: str
    port: int
    at_us: int

    def to_value(self) -> dict[str, Any]:
        """As a DUE value; time in ns."""
        return {"source": self.source, "service": self.service, "port": self.port, "at": self.at_us * 1000}


Output = Result | Captured | Handshake
