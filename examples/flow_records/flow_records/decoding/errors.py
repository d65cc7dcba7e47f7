"""The one error of all decoders."""

from typing import Literal

Cause = Literal["short", "version", "length", "count", "template", "limit"]
"""Why a datagram is refused: it ends too early; an unknown protocol; a length that cannot be; a number of records that
does not fit; a template that cannot be used; more than a decoder keeps."""


class FlowDecodeError(ValueError):
    """A datagram is not what its protocol says.

    Args:
        cause: the counter under which the refusal is shown.
        text: what is wrong.
    """

    def __init__(self, cause: Cause, text: str) -> None:
        super().__init__(text)
        self.cause: Cause = cause
