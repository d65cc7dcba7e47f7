"""Errors of the embedded switch.

DataplaneError
├── ProgramError         the JSON is not a program that this target can run (program.py)
│   └── Unsupported      it is well-formed, but uses something outside the documented subset
├── CompilerError        the generated C could not be built (compiler/)
├── InvalidIndex         an index outside a counter, meter or register array (externs.py)
└── TableError           a table operation that was refused
    ├── AlreadyExists    insert of an existing key
    ├── NotFound         modify, delete or read of a missing key
    ├── TableFull        the program's `size` is reached
    └── InvalidEntry     wrong kind, width, action, parameter, priority or a constant table
"""


class DataplaneError(Exception):
    """Root of all errors raised by this package."""


class ProgramError(DataplaneError):
    """The JSON cannot be read as a BMv2 program."""


class Unsupported(ProgramError):
    """The program uses a part of BMv2 that this target does not have; the text names it and its place."""


class CompilerError(DataplaneError):
    """The generated C could not be compiled or loaded."""


class InvalidIndex(DataplaneError):
    """An array index that the program did not declare."""


class TableError(DataplaneError):
    """A table operation that was refused."""


class AlreadyExists(TableError):
    """An entry with this match (and priority) is in the table."""


class NotFound(TableError):
    """No entry with this match (and priority)."""


class TableFull(TableError):
    """The table holds as many entries as the program gave it room for."""


class InvalidEntry(TableError):
    """The entry does not fit the table's key or actions."""
