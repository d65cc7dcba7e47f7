"""Errors of the embedded switch.

DataplaneError
├── ProgramError         the JSON is not a program that this target can run (program.py)
│   └── Unsupported      it is well-formed, but uses something outside the documented subset
├── CompilerError        the generated C could not be built (compiler/)
├── InvalidIndex         an index outside a counter, meter or register array (externs.py)
└── TableError           see tables.py
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
