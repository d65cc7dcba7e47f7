"""Operators' instructions → decisions and an answer: at once, after a restart, and out of the archive.

I/O: writes answers and lessons; reads the archive.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

import due
from apps.firewall.arrivals import evidence_of
from apps.firewall.enforcement.storing import StoredAnswers
from apps.firewall.evidence import history
from apps.firewall.evidence.archive import Archive
from apps.firewall.evidence.archived_state import ArchivedState
from apps.firewall.evidence_handler import EvidenceHandler
from apps.firewall.policy.false_alarms import FalseAlarms
from apps.firewall.policy.instructions import Desk, refused_as_foreign, refused_as_late
from apps.messages import Answer, Decision, Exhibit, Instruction, Intake, one_line
from due import DueError, Engine, Item

ARCHIVED_WORD_S = 2.0
CLOCKS_DIFFER_NS: Final = 2 * 3600 * 1_000_000_000
PANICS: Final = {"dataKey": history.INSTRUCTIONS, "value.verb": "panic"}
PANICS_KEPT: Final = 1_000

log = logging.getLogger(__name__)


class InstructionHandler:
    """What the service does with an operator's instruction; it takes the lock of the service itself.

    Args:
        engine: writes answers and lessons.
        desk: what each instruction means.
        past: what the archive says of earlier runs.
        archive: where a panic is looked for.
        lessons: what was called a false alarm.
        evidence: forgets what a lesson is about.
        intake: reads instructions out of the archive.
        lock: of the service.
        publish: writes a decision.
        allowed: tells switches and enforcers what the operator allows now.
        now: capture time, ns; 0 before the first switch has reported.
    """

    def __init__(
        self,
        engine: Engine,
        desk: Desk,
        past: ArchivedState,
        archive: Archive,
        lessons: FalseAlarms,
        evidence: EvidenceHandler,
        intake: Intake,
        lock: "threading.RLock",
        publish: Callable[[Decision], Decision],
        allowed: Callable[[], None],
        now: Callable[[], int],
    ) -> None:
        self._engine = engine
        self._desk = desk
        self._past = past
        self._archive = archive
        self._lessons = lessons
        self._evidence = evidence
        self._intake = intake
        self._lock = lock
        self._publish = publish
        self._allowed = allowed
        self._now = now
        self._stored = StoredAnswers(engine, threading.Lock())
        self._panics: deque[str] = deque(maxlen=PANICS_KEPT)
        """Ids of archived panics that were carried out."""

    def restore(self) -> None:
        """Take up what earlier runs were told, and what they answered."""
        self._stored.take_up(self._past.answers())
        self._desk.take_up(history.carried_out(self._past.instructions(), self._stored.carried_out()))
        self._panics.extend(self._past.panics())

    def health(self) -> dict[str, Any]:
        """Counters for the operator."""
        return {"allowed": len(self._desk.entries), "answers_unstored": self._stored.unstored}

    def instruct(self, item: Item, instruction: Instruction) -> None:
        """Carry an instruction out and answer it; again as before, if it came before."""
        self.answer_earlier()
        self._answer(item, instruction)

    def answer_earlier(self) -> None:
        """What an earlier run received, but did not answer, or answered without being heard."""
        with self._stored.catching_up() as now:
            if not now:
                return
            with suppress(DueError):
                self._engine.flush(ARCHIVED_WORD_S)  # what was refused until now was promised to nobody
            with self._lock:
                self._allowed()
            self._stored.take_up(self._past.answered())
            for key, answer in self._past.recent_answers():
                self._engine.write(key, answer.to_value(), [due.PUB_ONLY, due.NO_WAIT])
            for item, instruction in self._past.unanswered(self._stored):
                try:
                    self._answer(item, instruction)
                except DueError as error:  # it must not end this start, nor each one after it
                    log.error("%s", one_line(f"instruction {instruction.id} cannot be answered: {error}"))  # noqa: TRY400

    def read_archived_words(self) -> None:
        """A `blocks panic` while Data Updates were unreachable is in the archive only."""
        # the writer's clock may be behind ours, or ours may have been set back
        items = self._archive.look(PANICS, CLOCKS_DIFFER_NS, ARCHIVED_WORD_S)
        new: list[tuple[Item, Instruction]] = []
        with self._lock:
            for item in items:
                said = self._intake.read(history.INSTRUCTIONS, Instruction.from_item, item)
                if said is None or said.id in self._panics:
                    continue
                self._panics.append(said.id)
                if said.verb == "panic" and said.id not in self._stored:
                    new.append((item, said))
        for item, said in new:
            self._answer(item, said)  # so that no later start carries it out again

    def _answer(self, item: Item, instruction: Instruction) -> None:
        with self._lock:
            again = instruction.id in self._stored
            answer = self._stored.given(instruction.id) if again else self._carry_out(instruction, item)
        if answer is not None:
            answer, key = answer if again else self._stored.checked(answer), history.answer_key(item.key)
            self._engine.write(key, answer.to_value(), [due.NO_WAIT])
            # once this returns, those who sent the instruction need not send it again
            self._stored.keep(answer)

    def _carry_out(self, instruction: Instruction, item: Item) -> Answer:
        summary = f"{instruction.verb} {instruction.subject}: {instruction.reason}"
        evidence = evidence_of(item, summary)
        self._stored.began(instruction.id)
        early = (
            self._desk.decided_before(instruction, evidence)
            or refused_as_late(instruction, time.time_ns())
            or refused_as_foreign(instruction, item.app_id)
        )
        if early is not None:
            return early
        try:
            return self._decide(instruction, evidence)
        except DueError as error:
            log.error("%s", one_line(f"instruction {instruction.id} failed: {error}"))  # noqa: TRY400
            return Answer(id=instruction.id, done=False, text=f"failed: {error}")

    def _decide(self, instruction: Instruction, evidence: Exhibit) -> Answer:
        decisions, answer = self._desk.carry_out(instruction, evidence, self._now() or evidence.timestamp)
        failed: DueError | None = None
        for decision in decisions:
            try:
                self._publish(decision)
            except DueError as error:
                self._desk.take_back([decision])
                failed = failed or error
        if failed is not None:
            raise failed
        for lesson in self._lessons.told():
            self._evidence.learnt(lesson)
            self._engine.write(history.lesson_key(lesson), lesson.to_value(), [due.NO_WAIT])
        self._allowed()
        return answer
