"""Errors that the command line turns into one line and an exit code.

SdnatorError
├── BadInput            an input of the user cannot be used: exit code 2
└── PipelineError       a part of the pipeline did not start, or died: exit code 1
"""


class SdnatorError(Exception):
    """Base: the text says what, where and what to do."""

    exit_code = 1


class BadInput(SdnatorError):
    """An input of the user cannot be used."""

    exit_code = 2


class PipelineError(SdnatorError):
    """A part of the pipeline did not start, died or stopped answering."""
