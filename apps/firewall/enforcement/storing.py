"""What operators' programs were answered: `done` of nothing that a restart would forget, and again if they ask again.

I/O: waits for the archive, and asks it again later.
"""

import time
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Final

from msgspec import structs

from apps.firewall.evidence import archive
from apps.messages import Answer
from due import DueError, Engine

_PATIENCE_S: Final = 2.0
_SHORT_S: Final = 0.1
"""While storing fails every instruction waits for this long only: alerts wait behind it."""
_REMEMBERED: Final = 1000


class StoredAnswers:
    """Waits until decisions are in the archive or in its spool before they are answered as done.

    An instruction may come again after a restart of the firewall or of Data Updates, which may have lost the answer.
    """

    def __init__(self, engine: Engine, lock: AbstractContextManager[object]) -> None:
        self._engine = engine
        self._given: OrderedDict[str, Answer | None] = OrderedDict()
        """By the id of the instruction; None: it is being carried out, or its answer cannot be read."""
        self.unstored = 0
        """Answers that said so."""
        self._patience_s = _PATIENCE_S
        self._catching_up = lock
        self._behind = True
        self._ask_after = float("-inf")

    @contextmanager
    def catching_up(self) -> Iterator[bool]:
        """Whether to answer now what earlier runs did not; once, and newer instructions wait until it is done.

        Not before this instance works: after a kill the Coordinator still names the dead one for a while, and the
        decisions of another are refused.  If the archive does not answer, this is done again a little later.
        """
        with self._catching_up:
            now = self._behind and self._engine.active and time.monotonic() >= self._ask_after
            self._behind = self._behind and not now
            try:
                yield now
            except archive.NoAnswer:
                self._behind = True
                self._ask_after = time.monotonic() + archive.ASK_AGAIN_S

    def __contains__(self, instruction: object) -> bool:
        return instruction in self._given

    def given(self, instruction: str) -> Answer | None:
        """What was answered to this instruction."""
        return self._given.get(instruction)

    def carried_out(self) -> set[str]:
        """Instructions that were not refused."""
        return {each for each, answer in self._given.items() if answer is None or answer.done}

    def take_up(self, answers: Iterable[Answer]) -> None:
        """Answers of an earlier run."""
        for each in answers:
            self._note(each.id, each)

    def began(self, instruction: str) -> None:
        """It is being carried out, and not to be carried out again."""
        self._note(instruction, None)

    def checked(self, answer: Answer) -> Answer:
        """The answer itself, or one that says that it is in force, but not stored."""
        checked = self._checked(answer)
        self._note(answer.id, checked)
        return checked

    def keep(self, answer: Answer) -> None:
        """Wait until the answer itself is stored, too: what led to it is forgotten by those who sent it."""
        if answer.done:
            with suppress(DueError):
                self._engine.flush(self._patience_s)

    def _note(self, instruction: str, answer: Answer | None) -> None:
        self._given[instruction] = answer
        if len(self._given) > _REMEMBERED:
            self._given.popitem(last=False)

    def _checked(self, answer: Answer) -> Answer:
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
