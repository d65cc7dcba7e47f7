"""Refusals of the P4Runtime server, each with its canonical code (google.rpc.Code).

DataplaneError (errors.py)
└── Refused
    ├── InvalidArgument      3   the message contradicts the specification or the p4info
    ├── Missing              5   no such entity, device, role or saved pipeline
    ├── Exists               6   an entity with this key is there
    ├── Denied               7   not the primary, or a constant of the program
    ├── Exhausted            8   a table or a limit of the server is full
    ├── Precondition         9   no pipeline yet, or the stream belongs to another role
    ├── Aborted             10   undone because another update of its batch failed
    ├── OutOfRange          11   a value or index does not fit
    └── Unimplemented       12   outside what this target has
"""

from typing import Any, ClassVar

import grpc

from dataplane.errors import AlreadyExists, DataplaneError, InvalidIndex, NotFound, TableFull
from p4rt import p4runtime, status

OK = 0
UNKNOWN = 2
SPACE = "sdnator-embedded"


class Refused(DataplaneError):
    """A request, or one update of it, that the server does not carry out."""

    code: ClassVar[int] = UNKNOWN


class InvalidArgument(Refused):
    """The message contradicts the specification or the p4info."""

    code = 3


class MissingEntity(Refused):
    """No such entity, device, role or saved pipeline."""

    code = 5


class Exists(Refused):
    """An entity with this key is there."""

    code = 6


class Denied(Refused):
    """Not the primary, or a constant of the program."""

    code = 7


class Exhausted(Refused):
    """A table or a limit of the server is full."""

    code = 8


class Precondition(Refused):
    """No pipeline yet, or the stream belongs to another device or role."""

    code = 9


class Aborted(Refused):
    """Undone because another update of its batch failed."""

    code = 10


class OutOfRange(Refused):
    """A value or index does not fit."""

    code = 11


class Unimplemented(Refused):
    """Outside what this target has."""

    code = 12


_CODES: dict[int, grpc.StatusCode] = {code.value[0]: code for code in grpc.StatusCode}
_OF_ENGINE: tuple[tuple[type[DataplaneError], type[Refused]], ...] = (
    (AlreadyExists, Exists),
    (NotFound, MissingEntity),
    (TableFull, Exhausted),
    (InvalidIndex, OutOfRange),
)


def of(error: DataplaneError) -> Refused:
    """The refusal that an error of the switch engine means to a controller."""
    if isinstance(error, Refused):
        return error
    for engine, refusal in _OF_ENGINE:
        if isinstance(error, engine):
            return refusal(str(error))
    return InvalidArgument(str(error))


def grpc_code(error: Refused) -> grpc.StatusCode:
    """The gRPC status code of a refusal."""
    return _CODES[error.code]


def details(errors: list[Refused | None], what: str) -> bytes:
    """`grpc-status-details-bin` of a batch: one p4.v1.Error per update, in order.

    errors: None = that update succeeded
    what: the request's name in the message, such as "Write"
    """
    whole: Any = status.Status(code=UNKNOWN, message=f"{what} failure: {_summary(errors)}")
    for error in errors:
        one = p4runtime.Error(canonical_code=OK)
        if error is not None:
            one = p4runtime.Error(canonical_code=error.code, message=str(error), space=SPACE, code=error.code)
        whole.details.add().Pack(one)
    return bytes(whole.SerializeToString())


def _summary(errors: list[Refused | None]) -> str:
    failed = sum(error is not None for error in errors)
    return f"{failed} of {len(errors)} failed, see the details"
