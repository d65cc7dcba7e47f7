"""Every error that the Sonata adapter raises.

SonataError
├── QueryError          a query is wrong (also a ValueError)
│   └── QueryTextError  ... in its text form: names line and column
├── InvalidRequest      a key names an unknown query or parameter (also a ValueError)
└── NotPlaced           a part of a query cannot be expressed in the switch (the planner's own use)
"""


class SonataError(Exception):
    """Base of all errors of the adapter."""


class QueryError(SonataError, ValueError):
    """Operators, fields or types of a query do not fit together."""


class QueryTextError(QueryError):
    """The text of a query is wrong.  `line` and `column` count from 1."""

    def __init__(self, where: str, line: int, column: int, what: str) -> None:
        super().__init__(f"{where}:{line}:{column}: {what}")
        self.line = line
        self.column = column


class InvalidRequest(SonataError, ValueError):
    """A key names an unknown query or parameter, or a value out of bounds; the text says what is accepted."""


class NotPlaced(SonataError):
    """The switch cannot execute a part of a query; the text says why."""
