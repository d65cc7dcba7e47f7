"""Whether what was decided is stored: an operator hears `done` of nothing that a restart would forget."""

from typing import Final

from msgspec import structs

from apps.messages import Answer
from due import DueError, Engine

_PATIENCE_S: Final = 2.0
_SHORT_S: Final = 0.1
"""While storing fails every instruction waits for this long only: alerts wait behind it."""


class StoredAnswers:
    """Waits until decisions are in the archive or in its spool before they are answered as done."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.unstored = 0
        """Answers that said so."""
        self._patience_s = _PATIENCE_S

    def checked(self, answer: Answer) -> Answer:
        """The answer itself, or one that says that it is in force, but not stored."""
        if not answer.done:
            return answer
        try:
            self._engine.flush(self._patience_s)
        except DueError as error:
            self._patience_s = _SHORT_S
            self.unstored += 1
            text = (
                f"{answer.text}; in force, but not stored, so that a restart of the firewall may forget it:"
                f" repeat it when there is room on the disk, or the archive is back ({error})"
            )
            return structs.replace(answer, done=False, text=text)
        self._patience_s = _PATIENCE_S
        return answer
