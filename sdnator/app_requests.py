"""Ask a running app for something as the operator, and wait for its answer."""

import os
import queue
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

from apps.messages import Answer
from due import CONSUMER, PRODUCER, Capability, DueError, Engine, Item
from due.config import Options
from sdnator.errors import BadInput, PipelineError
from sdnator.rights.audit_trail import note
from sdnator.up import running

_LOOK_SECONDS: Final = 0.5
_CLOCKS_DIFFER_NS: Final = 60 * 10**9


@dataclass(frozen=True)
class AppRequest:
    """An instruction and where its answer comes."""

    app: str
    """The app that is asked."""
    key: str
    answer: str
    """Key of the answer."""
    id: str
    value: dict[str, Any]


def ask(question: AppRequest, updates: str, archive: str, patience: float) -> str:
    """Write an instruction and wait for its answer.

    Args:
        question: what is asked.
        updates: Data Updates URL; empty: $DUE_UPDATES, or the running pipeline's.
        archive: Data Archives URL.
        patience: seconds to wait.

    Returns:
        What the app says.

    Raises:
        BadInput: the app refuses.
        PipelineError: no pipeline runs, or the app does not answer; the instruction is then withdrawn.
    """
    url = updates or os.environ.get("DUE_UPDATES") or running.need().updates
    engine = Engine(Options(connect_timeout=2.0))
    engine.set_pubsub(url)
    engine.set_db(archive)
    answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()

    def on_answer(item: Item) -> None:
        answer = Answer.from_value(item.value)
        if answer.id == question.id:
            answers.put(answer)

    told = Capability(question.key, delivery="reliable", archive="always")
    engine.init("operator", PRODUCER | CONSUMER, capabilities=[told], instances="shared")
    try:
        engine.observe(question.answer).subscribe(on_answer)
        engine.write(question.key, question.value)
        engine.flush(patience)
        answer = _answer(engine, question, answers, on_answer, patience)
    except DueError as error:
        raise PipelineError(
            f"the {question.app} cannot be reached ({error}); the instruction was not and will not be carried out"
        ) from error
    finally:
        engine.close()
    words = " ".join(str(question.value.get(name) or "") for name in ("verb", "subject", "reason")).split()
    outcome = "told" if answer.done else "was refused by"
    note(f"{outcome} the {question.app}: {' '.join(words)}", instruction=question.id, archive=archive)
    if not answer.done:
        raise BadInput(answer.text)
    return answer.text


def _answer(
    engine: Engine,
    question: AppRequest,
    answers: "queue.SimpleQueue[Answer]",
    look: Callable[[Item], None],
    patience: float,
) -> Answer:
    """The next of `answers`; raises PipelineError after `patience` seconds.

    The app may answer before our interest has reached it; then only the archive has the answer.
    """
    begun, deadline = time.time_ns() - _CLOCKS_DIFFER_NS, time.monotonic() + patience
    while time.monotonic() < deadline:
        try:
            return answers.get(timeout=_LOOK_SECONDS)
        except queue.Empty:
            with suppress(DueError):
                for item in engine.get({"dataKey": question.answer, "timestamp": {"$gte": begun}}):
                    look(item)
    raise PipelineError(
        f"the {question.app} did not answer within {patience:.0f} s, so the instruction is withdrawn; "
        "see `sdnator status` and try again"
    )
