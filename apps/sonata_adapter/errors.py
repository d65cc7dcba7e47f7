"""Everything that the Sonata adapter raises.

SonataError
├── InvalidQuery        a query is built wrongly (also a ValueError)
│   └── QueryTextError  ... in its text form: says line and column
├── InvalidRequest      a key asks for a query or parameter that there is not (also a ValueError)
└── NotPlaced           a part of a query cannot be expressed in the switch (the planner's own use)
"""


class SonataError(Exception):
    """Base of all errors of the adapter."""


class InvalidQuery(SonataError, ValueError):
    """Operators, fields or types of a query do not fit together."""


class QueryTextError(InvalidQuery):
    """The text of a query is wrong.  `line` and `column` count from 1."""

    def __init__(self, where: str, line: int, column: int, what: str) -> None:
        super().__init__(f"{where}:{line}:{column}: {what}")
        self.line = line
        self.column = column


class InvalidRequest(SonataError, ValueError):
    """A key names no query, an unknown parameter or a value out of bounds; the text says what would do."""


class NotPlaced(SonataError):
    """A part of a query that the switch cannot do; the text says why."""
