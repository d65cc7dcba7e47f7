"""Results that are known when a window is over, of one query on one switch."""

from collections.abc import Iterable

from apps.sonata_adapter.query.language import Query
from apps.sonata_adapter.results import QueryResult


class WindowEnds:
    """Where the windows of a query lie, by number, and results of them.

    `base_us`: the switch's clock zero.  `since_us`: when the query came into force, if frames were seen before, or
    the clock was set back.
    """

    def __init__(self, query: Query, base_us: int, since_us: int | None) -> None:
        self._query = query
        self._base_us = base_us
        self.since_us = since_us
        self.length_us = query.window_us

    def end_us(self, number: int) -> int:
        """When it is over."""
        return self._base_us + (number + 1) * self.length_us

    def middle_us(self, number: int) -> int:
        """A time that is surely in it."""
        return self.end_us(number) - self.length_us // 2

    def result(self, number: int, fields: dict[str, int | str], errors: Iterable[str]) -> QueryResult:
        """With errors it is an estimate."""
        start, error = self.end_us(number) - self.length_us, "; ".join(errors)
        return QueryResult(
            query=self._query.name,
            window_us=start,
            length_us=self.length_us,
            at_us=self.end_us(number),
            fields=fields,
            exact=not error,
            partial=self.since_us is not None and self.since_us > start,
            error=error,
        )
