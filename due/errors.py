"""Every error that DUE raises.

    DueError
    ├── InvalidKey            a key breaks the grammar (also a ValueError)
    ├── UnsupportedValue      a value is of no DUE type (also a TypeError)
    ├── InvalidQuery          a query breaks the MongoDB dialect (also a ValueError)
    ├── InvalidOption         an option or URL is wrong (also a ValueError)
    ├── NotInitialised        the engine was used before `init` or after `close`
    ├── NotAllowed            the engine's role does not include the operation
    ├── DecodeError           bytes from a backend are not a valid frame or value
    │   └── NewerVersion      ... because a newer DUE wrote them
    ├── RefusedFrame          a frame does not belong on its channel, or its numbers are impossible
    ├── Superseded            another instance took this one's place before its writes were acknowledged
    ├── EngineFailed          a thread of the engine has died: nothing is sent or received any more
    └── BackendError          a backend refused a request or failed
        ├── UpdatesUnavailable    Data Updates cannot be reached (now)
        ├── ArchiveUnavailable    Data Archives cannot be reached (now)
        └── Timeout               a backend did not answer in time

Drivers turn the errors of their client libraries into `BackendError`s: callers see this tree only.
"""


class DueError(Exception):
    """Base of all errors of DUE."""


class InvalidKey(DueError, ValueError):
    """A key breaks the grammar.  `key`, `position` (index of the character) and `rule` say where and why."""

    def __init__(self, key: str, position: int, rule: str) -> None:
        shown = key if len(key) <= 120 else key[:117] + "..."
        super().__init__(f"invalid key {shown!r} at position {position}: {rule}")
        self.key = key
        self.position = position
        self.rule = rule


class UnsupportedValue(DueError, TypeError):
    """A value cannot be encoded: it is of no DUE type."""


class InvalidQuery(DueError, ValueError):
    """A query of `get` uses an unknown field or operator, or a wrong operand."""


class InvalidOption(DueError, ValueError):
    """An option or a URL is wrong; the message names it and says what is accepted."""


class NotInitialised(DueError):
    """The engine is not initialised yet, or already closed."""


class NotAllowed(DueError):
    """The operation needs a role that was not given to `init`."""


class DecodeError(DueError):
    """Bytes are not a valid frame or value of this wire format."""


class NewerVersion(DecodeError):
    """Bytes were written by a newer version of the wire format."""


class RefusedFrame(DueError):
    """A frame does not belong on its channel, or its numbers are impossible.  `cause` names the counter in
    `health`."""

    def __init__(self, cause: str, text: str) -> None:
        super().__init__(text)
        self.cause = cause


class Superseded(DueError):
    """Another instance took this one's place, and what this one wrote last may have been refused."""


class EngineFailed(DueError):
    """A thread of the engine has died of a bug: nothing is sent or received any more."""


class BackendError(DueError):
    """A backend refused a request or failed."""


class UpdatesUnavailable(BackendError):
    """The Data Updates server cannot be reached; the engine keeps trying."""


class ArchiveUnavailable(BackendError):
    """The Data Archives server or file cannot be reached or written now; trying again may help."""


class Timeout(BackendError):
    """A backend did not answer in time."""
