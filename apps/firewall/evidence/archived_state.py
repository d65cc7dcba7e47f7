"""State that the firewall restores from Data Archives at its start.  I/O."""

import logging
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Container, Iterable
from contextlib import suppress
from typing import Any, Final, NamedTuple, TypeVar

from msgspec import structs

from apps.evidence import TRAINING, TrainingState
from apps.firewall.arrivals import answer_in, handshake_in, training_in
from apps.firewall.enforcement.switch_entries import KEPT, leftovers
from apps.firewall.evidence.archive import MOST, Archive, NoAnswer
from apps.firewall.evidence.history import ANSWERS, DECISIONS, INSTRUCTIONS, LESSONS
from apps.firewall.evidence.known_sources import HANDSHAKES, KnownSources
from apps.firewall.settings import Settings
from apps.incidents import INCIDENTS, Incident
from apps.messages import (
    LONGEST_BLOCK_S,
    Answer,
    Decision,
    FalseAlarm,
    Instruction,
    Intake,
    MessageError,
    TableCommand,
    TableUpdate,
)
from apps.standing_decisions import in_force
from due import Item

_PATIENCE_S: Final = 30.0
_LATER_PATIENCE_S: Final = 120.0
"""In the background nobody waits for an answer."""
UNREAD: Final = "Data Archives have not answered since the start: who is allowed is not known (history)"
_DAY_NS: Final = 86_400_000_000_000
_LONGEST_NS: Final = LONGEST_BLOCK_S * 1_000_000_000 + _DAY_NS
"""Longest block plus a day for clock changes: older decisions are no longer in force."""
_INSTRUCTIONS: Final = 20_000
_ANSWERS: Final = 1_000
_ASKED_AT_ONCE: Final = 200
"""Instructions whose answers are looked up by one query."""
_UNANSWERED: Final = 1_000
_TOLD_AGAIN: Final = 100
_MEANWHILE: Final = 10_000
"""Decisions made before `past` is known."""
_RECENT_NS: Final = 2 * 3600 * 1_000_000_000
"""Longer than the wall clocks of two machines differ."""
_INCIDENTS: Final = 20_000
_LESSONS: Final = 20_000
_SOURCE_SHARE: Final = 10
"""Archived handshakes read per known source."""

_T = TypeVar("_T")
log = logging.getLogger(__name__)


class PastState(NamedTuple):
    """What the archive says of earlier runs, oldest first."""

    answers: list[Answer]
    """The most recent ones."""
    allowing: list[Instruction]
    """Instructions that change the allow-list.  Those that were carried out have no deadline any more."""
    panics: list[str]
    """Ids of panics, which were carried out already."""
    decisions: list[Decision]
    """Without dry runs; `in_force` says which of them stand."""
    incidents: list[Incident]
    """Those that may still be open."""
    false_alarms: list[FalseAlarm]
    """What operators have called false alarms, and taken back."""
    training: TrainingState | None
    """How far training was when that was last said; None if nothing was."""
    handshakes: list[tuple[str, int]]
    """Source and capture time."""
    kept: dict[str, list[Item]]
    """Commands about the firewall's own entries, by switch."""


class ArchivedState:
    """Reads each kind of message with limits; `intake` counts malformed ones.

    While `past` is not known, nothing may be concluded from it: an archive that does not answer is not an empty one.
    """

    def __init__(self, archive: Archive, intake: Intake, settings: Settings) -> None:
        self.archive = archive
        self._intake = intake
        self._settings = settings
        self._away_since: int | None = None
        """When the first reading failed, ns: what was written later is this run's."""
        self._reading: threading.Thread | None = None
        self._meanwhile: deque[Decision] = deque(maxlen=_MEANWHILE)
        self.past: PastState | None = None
        """None until the archive has answered."""
        self.is_taken_up = False

    # -- at the start ----------------------------------------------------------------------------------

    def read(self, patience_s: float = _PATIENCE_S) -> bool:
        """Ask for `past`; returns whether it is known, which takes an answer to every question.

        Args:
            patience_s: how long one question may take, in seconds.
        """
        try:
            self.past = self._ask(patience_s)
        except NoAnswer:
            self._away_since = self._away_since or time.time_ns()
            return False
        return True

    def read_later(self) -> bool:
        """Ask in the background, time and again with pauses; returns whether `past` is known.  Never waits."""
        if self.past is None and not self.archive.away and not (self._reading and self._reading.is_alive()):
            asked = (_LATER_PATIENCE_S,)
            self._reading = threading.Thread(target=self.read, args=asked, name="archived state", daemon=True)
            self._reading.start()
        return self.past is not None

    def taken_up(self) -> None:
        """`past` has been taken up, and is not kept."""
        self.past = None
        self._meanwhile.clear()
        self.is_taken_up = True

    def decided(self, decision: Decision) -> None:
        """A decision was made; `past` may not have it when it becomes known."""
        if not self.is_taken_up and not decision.dry_run:
            self._meanwhile.append(decision)

    def _ask(self, patience_s: float) -> PastState:
        def read(
            query: str | dict[str, Any],
            kind: str,
            decode: Callable[[Item], _T],
            back_ns: int = 0,
            most: int = MOST,
        ) -> list[_T]:
            since = time.time_ns() - back_ns if back_ns else 0
            return self._read(query, kind, decode, since=since, most=most, patience_s=patience_s)

        settings = self._settings
        answers = read(f"{ANSWERS}.*", "answer", answer_in, most=_ANSWERS)
        changes = {"dataKey": INSTRUCTIONS, "value.verb": {"$in": ["allow", "disallow"]}}
        said = read(changes, "instruction", Instruction.from_item, most=_INSTRUCTIONS)
        allowing = self._with_answers(said, answers, lambda query: read(query, "answer", answer_in))
        panics = {"dataKey": INSTRUCTIONS, "value.verb": "panic"}
        panicked = read(panics, "instruction", Instruction.from_item, most=_ANSWERS)
        made = [each for key in DECISIONS for each in read(key, "decision", Decision.from_item, _LONGEST_NS)]
        days, most = settings.known_days + 1, _SOURCE_SHARE * settings.known_limit
        shakes: list[tuple[str, int]] = []
        if settings.learn:
            shakes = read(HANDSHAKES, "handshake", _archived_handshake, days * _DAY_NS, most)
        kept: defaultdict[str, list[Item]] = defaultdict(list)
        for item in read(f"{KEPT}.*", "command", _whole_command):
            kept[item.key.rpartition(".")[2]].append(item)
        incidents = read(INCIDENTS, "incident", _dated_incident, _LONGEST_NS, _INCIDENTS)
        return PastState(
            answers=answers,
            allowing=allowing,
            panics=[each.id for each in panicked],
            decisions=[each for each in made if not each.dry_run],
            # more is known here of those that were written since
            incidents=[each for at, each in incidents if self._away_since is None or at < self._away_since],
            false_alarms=read(LESSONS, "false alarm", FalseAlarm.from_item, most=_LESSONS),
            training=next(iter(read(f"{TRAINING}.*", "training", training_in, most=1)), None),
            handshakes=shakes,
            kept=kept,
        )

    @staticmethod
    def _with_answers(
        said: list[Instruction], answers: list[Answer], ask: Callable[[dict[str, Any]], list[Answer]]
    ) -> list[Instruction]:
        """For each entry of the allow-list what was carried out last, and what is later than that.

        The newest answers are known; there may have been any number since an entry was changed.
        """
        heard = {each.id for each in answers}
        done = {each.id for each in answers if each.done}
        found: list[Instruction] = []
        settled: set[str] = set()
        for end in range(len(said), 0, -_ASKED_AT_ONCE):
            some = [each for each in said[max(0, end - _ASKED_AT_ONCE) : end] if each.subject not in settled]
            if unheard := [each.id for each in some if each.expires and each.id not in heard]:
                older = ask({"dataKey": f"{ANSWERS}.*", "value.id": {"$in": unheard}})
                done |= {each.id for each in older if each.done}
            for each in reversed(some):
                carried_out = not each.expires or each.id in done
                if each.subject not in settled:
                    found.append(structs.replace(each, expires=0) if carried_out else each)
                if carried_out:
                    settled.add(each.subject)
        return found[::-1]

    def standing(self) -> list[Decision]:
        """Of earlier runs, the newest decision for each target, if it is in force and none was made since."""
        new = {each.id for each in self._meanwhile}
        earlier = [] if self.past is None else self.past.decisions
        return [each for each in in_force([*earlier, *self._meanwhile]) if each.id not in new]

    def instructions(self) -> list[Instruction]:
        """Instructions that change the allow-list, oldest first; those that were carried out have no deadline."""
        return [] if self.past is None else self.past.allowing

    def answers(self) -> list[Answer]:
        """What earlier runs answered most recently."""
        return [] if self.past is None else self.past.answers

    def panics(self) -> list[str]:
        """Ids of the panics in the archive, which were carried out already."""
        return [] if self.past is None else self.past.panics

    def teach(self, known: KnownSources) -> None:
        """Known sources, from the handshakes of the last `known_days`."""
        later = known.times()
        for source, at in () if self.past is None else self.past.handshakes:  # oldest first
            known.learn(source, at)
        for source, at in later:  # seen in this run already: the last to be dropped
            known.learn(source, at)
        log.info("%d known sources in the archive", len(known))

    def leftovers(self, wanted: Iterable[TableUpdate]) -> dict[str, list[TableUpdate]]:
        """By switch: deletions of entries of an earlier run that are no longer wanted."""
        kept = {} if self.past is None else self.past.kept
        return {switch: leftovers(items, wanted) for switch, items in kept.items()}

    # -- later -----------------------------------------------------------------------------------------

    def answered(self) -> list[Answer]:
        """What was answered most recently.

        Raises:
            NoAnswer: the archive does not answer, or `past` is not taken up yet.
        """
        if not self.is_taken_up:
            raise NoAnswer
        return self._read(f"{ANSWERS}.*", "answer", answer_in, most=_ANSWERS)

    def recent_answers(self) -> list[tuple[str, Answer]]:
        """The newest answers, with their keys: whom they were for may not have heard them.

        Raises:
            NoAnswer: the archive does not answer.
        """
        since = time.time_ns() - _RECENT_NS
        return self._read(f"{ANSWERS}.*", "answer", _keyed_answer, since=since, most=_TOLD_AGAIN)

    def unanswered(self, answered: Container[str]) -> list[tuple[Item, Instruction]]:
        """Recent instructions that an earlier run received, or not, and did not answer; oldest first.

        Raises:
            NoAnswer: the archive does not answer.
        """
        since = time.time_ns() - _RECENT_NS
        found = self._read(INSTRUCTIONS, "instruction", _whole_instruction, since=since, most=_UNANSWERED)
        return [each for each in found if each[1].id not in answered]

    def decision(self, name: str) -> Decision | None:
        """A decision by its id, as it was made; None if the archive has none or does not answer."""
        for key in DECISIONS:
            with suppress(NoAnswer):
                found = self._read({"dataKey": key, "value.id": name}, "decision", Decision.from_item)
                if found:
                    return found[0]
        return None

    def _read(
        self,
        query: str | dict[str, Any],
        kind: str,
        decode: Callable[[Item], _T],
        *,
        since: int = 0,
        most: int = MOST,
        patience_s: float | None = None,
    ) -> list[_T]:
        items = self.archive.find(query, patience_s, since=since, most=most)
        if items is None:
            raise NoAnswer
        found = (self._intake.read(kind, decode, item) for item in items)
        return [each for each in found if each is not None]


def _keyed_answer(item: Item) -> tuple[str, Answer]:
    return item.key, answer_in(item)


def _whole_instruction(item: Item) -> tuple[Item, Instruction]:
    return item, Instruction.from_item(item)


def _whole_command(item: Item) -> Item:
    TableCommand.from_item(item)
    return item


def _dated_incident(item: Item) -> tuple[int, Incident]:
    return item.timestamp, Incident.from_item(item)


def _archived_handshake(item: Item) -> tuple[str, int]:
    source, _, at = handshake_in(item)
    if at > item.timestamp + _DAY_NS:
        raise MessageError("time", f"{item.key}: its time {at} is a day or more after it was written")
    return source, at
