"""What arrives is untrusted: values are checked, and refusals counted.

item ──decode──► message, or MessageError ──► Intake counts it, and says so once a minute
"""

import logging
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Final, Literal, TypeVar

from due import Item

Cause = Literal["shape", "fields", "size", "range", "sender", "columns", "time"]
"""Why a message is refused: no map or batch; a wrong field; too large or too deep; a number out of range; written by
another app than its key says; a wrong column; a time that cannot be."""

MOST_DEPTH: Final = 12
MOST_PARTS: Final = 200_000
"""Values in one message, at all depths."""
MOST_TEXT: Final = 4 << 20
"""Characters and bytes in one message."""

_ATOMS: Final = (bool, int, float, type(None))
_SHOWN: Final = 300
_SAY_EVERY_S: Final = 60.0


class MessageError(ValueError):
    """A value is not the message that its key promises.

    Args:
        cause: the counter under which the refusal is reported.
        text: what is wrong; shortened to one line.
    """

    def __init__(self, cause: Cause, text: str) -> None:
        super().__init__(one_line(text))
        self.cause: Cause = cause


def one_line(text: str) -> str:
    """Make a text fit for a log.

    Args:
        text: any text.

    Returns:
        One line without control characters, of 300 characters at most.
    """
    shown = text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
    if shown.isprintable():
        return shown  # the same text, not a copy: many are kept
    return "".join(char if char.isprintable() else f"\\x{ord(char):02x}" for char in shown)


def check_plain(value: object, what: str) -> None:
    """Refuse a value that holds anything but maps, lists and atoms, or too much of them.

    It does not recurse, because a sender may nest values as deeply as it likes.

    Args:
        value: a decoded value.
        what: what it should be, for the error message.

    Raises:
        MessageError: the value holds other types, is too deep or too large.
    """
    waiting: list[tuple[object, int]] = [(value, 0)]
    parts = text = 0
    while waiting:
        part, depth = waiting.pop()
        kind = type(part)
        if isinstance(part, str | bytes):
            text += len(part)
        elif isinstance(part, dict | list | tuple):
            parts += len(part)
            if depth == MOST_DEPTH or parts > MOST_PARTS:
                raise MessageError(
                    "size", f"{what}: nested deeper than {MOST_DEPTH} or over {MOST_PARTS:,} values"
                )
            if isinstance(part, dict):
                text += sum(len(name) for name in part if isinstance(name, str))
            waiting.extend((each, depth + 1) for each in (part.values() if isinstance(part, dict) else part))
        elif kind not in _ATOMS:
            raise MessageError("shape", f"{what}: {kind.__name__} is not a plain value")
        if text > MOST_TEXT:
            raise MessageError("size", f"{what}: over {MOST_TEXT:,} characters")


def as_map(value: object, what: str) -> dict[str, Any]:
    """Check that a value is a map of plain values.

    Args:
        value: a decoded value.
        what: what it should be, for the error message.

    Returns:
        The same map.

    Raises:
        MessageError: it is not a map, or `check_plain` refuses it.
    """
    if type(value) is not dict:
        raise MessageError("shape", f"{what}: a map is expected, not {type(value).__name__}")
    check_plain(value, what)
    return value


_T = TypeVar("_T")


class Intake:
    """Refusals of received messages: counted by cause, and logged once a minute for each kind and cause.

    Args:
        log: logger for the refusals.
        clock: monotonic time, seconds.
    """

    def __init__(self, log: logging.Logger, clock: Callable[[], float] = time.monotonic) -> None:
        self._log = log
        self._clock = clock
        self._causes: Counter[Cause] = Counter()
        self._said: dict[tuple[str, Cause], float] = {}

    def read(self, kind: str, decode: Callable[[Item], _T], item: Item) -> _T | None:
        """Decode an item.

        Args:
            kind: kind of message, to group the log lines.
            decode: makes the message; may raise `MessageError` and nothing else.
            item: the received item.

        Returns:
            The message; None if it was refused.
        """
        try:
            return decode(item)
        except MessageError as error:
            self.refuse(kind, error, item.key)
            return None

    def reading(
        self, kind: str, decode: Callable[[Item], _T], act: Callable[[Item, _T], None]
    ) -> Callable[[Item], None]:
        """Make a callback for an observation.

        Args:
            kind: kind of message, to group the log lines.
            decode: makes the message; may raise `MessageError` and nothing else.
            act: called with each item and its message, unless refused.

        Returns:
            The callback.
        """

        def callback(item: Item) -> None:
            message = self.read(kind, decode, item)
            if message is not None:
                act(item, message)

        return callback

    def refuse(self, kind: str, error: MessageError, where: str) -> None:
        """Count a refusal; log it unless one of this kind and cause was logged within the last minute.

        Args:
            kind: kind of message.
            error: why it is refused.
            where: key under which it arrived.
        """
        self._causes[error.cause] += 1
        now, name = self._clock(), (kind, error.cause)
        if now - self._said.get(name, now - _SAY_EVERY_S) >= _SAY_EVERY_S:
            self._said[name] = now
            text = "refused a message under %s (%s): %s; further ones are only counted"
            self._log.warning(text, one_line(where), error.cause, error)

    def health(self) -> dict[str, Any]:
        """Counters of the refusals.

        Returns:
            `refused_messages`, and `refused_by_cause`: cause to count.
        """
        return {"refused_messages": sum(self._causes.values()), "refused_by_cause": dict(self._causes)}
