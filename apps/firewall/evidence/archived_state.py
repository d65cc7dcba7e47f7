"""State that the firewall restores from Data Archives at its start.  I/O."""

import logging
import time
from collections import defaultdict
from collections.abc import Callable, Container, Iterable
from typing import Any, Final, TypeVar

from apps.evidence import TRAINING, TrainingState
from apps.firewall.arrivals import answer_in, handshake_in, training_in
from apps.firewall.enforcement.switch_entries import KEPT, leftovers
from apps.firewall.evidence.archive import MOST, Archive
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
_DAY_NS: Final = 86_400_000_000_000
_LONGEST_NS: Final = LONGEST_BLOCK_S * 1_000_000_000 + _DAY_NS
"""Longest block plus a day for clock changes: older decisions are no longer in force."""
_INSTRUCTIONS: Final = 20_000
_ANSWERS: Final = 1_000
_UNANSWERED: Final = 1_000
_TOLD_AGAIN: Final = 100
_RECENT_NS: Final = 2 * 3600 * 1_000_000_000
"""Longer than the wall clocks of two machines differ."""
_INCIDENTS: Final = 20_000
_LESSONS: Final = 20_000
_SOURCE_SHARE: Final = 10
"""Archived handshakes read per known source."""

_T = TypeVar("_T")
log = logging.getLogger(__name__)


class ArchivedState:
    """Reads each kind of message with limits; `intake` counts malformed ones."""

    def __init__(self, archive: Archive, intake: Intake, settings: Settings) -> None:
        self._archive = archive
        self._intake = intake
        self._settings = settings

    def instructions(self) -> list[Instruction]:
        """Instructions that change the allow-list, oldest first."""
        query = {"dataKey": INSTRUCTIONS, "value.verb": {"$in": ["allow", "disallow"]}}
        return self._read(query, "instruction", Instruction.from_item, most=_INSTRUCTIONS)

    def answered(self) -> list[Answer]:
        """What was answered most recently."""
        return self._read(f"{ANSWERS}.*", "answer", answer_in, most=_ANSWERS)

    def recent_answers(self) -> list[tuple[str, Answer]]:
        """The newest answers, with their keys: whom they were for may not have heard them."""
        since = time.time_ns() - _RECENT_NS
        return self._read(f"{ANSWERS}.*", "answer", _keyed_answer, since=since, most=_TOLD_AGAIN)

    def unanswered(self, answered: Container[str]) -> list[tuple[Item, Instruction]]:
        """Recent instructions that an earlier run received, or not, and did not answer; oldest first."""
        since = time.time_ns() - _RECENT_NS
        found = self._read(INSTRUCTIONS, "instruction", _whole_instruction, since=since, most=_UNANSWERED)
        return [each for each in found if each[1].id not in answered]

    def panics(self) -> list[str]:
        """Ids of the panics in the archive, which were carried out already."""
        query = {"dataKey": INSTRUCTIONS, "value.verb": "panic"}
        return [each.id for each in self._read(query, "instruction", Instruction.from_item, most=_ANSWERS)]

    def standing(self) -> list[Decision]:
        """The newest decision for each target, if it is in force."""
        since = time.time_ns() - _LONGEST_NS
        read = (self._read(key, "decision", Decision.from_item, since=since) for key in DECISIONS)
        return in_force(each for found in read for each in found if not each.dry_run)

    def decision(self, name: str) -> Decision | None:
        """A decision by its id, as it was made; None if the archive has none or does not answer."""
        for key in DECISIONS:
            found = self._read({"dataKey": key, "value.id": name}, "decision", Decision.from_item)
            if found:
                return found[0]
        return None

    def false_alarms(self) -> list[FalseAlarm]:
        """What operators have called false alarms, and taken back, oldest first."""
        return self._read(LESSONS, "false alarm", FalseAlarm.from_item, most=_LESSONS)

    def training(self) -> TrainingState | None:
        """How far training was when that was last said; None if nothing was."""
        return next(iter(self._read(f"{TRAINING}.*", "training", training_in, most=1)), None)

    def incidents(self) -> list[Incident]:
        """Reports of incidents that may still be open, oldest first."""
        since = time.time_ns() - _LONGEST_NS
        return self._read(INCIDENTS, "incident", Incident.from_item, since=since, most=_INCIDENTS)

    def teach(self, known: KnownSources) -> None:
        """Known sources, from the handshakes of the last `known_days`."""
        days, most = self._settings.known_days, _SOURCE_SHARE * self._settings.known_limit
        since = time.time_ns() - (days + 1) * _DAY_NS
        shakes = self._read(HANDSHAKES, "handshake", _archived_handshake, since=since, most=most)
        for source, at in shakes:  # oldest first
            known.learn(source, at)
        log.info("%d known sources in the archive", len(known))

    def leftovers(self, wanted: Iterable[TableUpdate]) -> dict[str, list[TableUpdate]]:
        """By switch: deletions of entries of an earlier run that are no longer wanted."""
        past: defaultdict[str, list[Item]] = defaultdict(list)
        for item in self._archive.find(f"{KEPT}.*", _PATIENCE_S) or ():
            if self._intake.read("command", TableCommand.from_item, item) is not None:
                past[item.key.rpartition(".")[2]].append(item)
        return {switch: leftovers(items, wanted) for switch, items in past.items()}

    def _read(
        self,
        query: str | dict[str, Any],
        kind: str,
        decode: Callable[[Item], _T],
        *,
        since: int = 0,
        most: int = MOST,
    ) -> list[_T]:
        items = self._archive.find(query, _PATIENCE_S, since=since, most=most) or ()
        found = (self._intake.read(kind, decode, item) for item in items)
        return [each for each in found if each is not None]


def _keyed_answer(item: Item) -> tuple[str, Answer]:
    return item.key, answer_in(item)


def _whole_instruction(item: Item) -> tuple[Item, Instruction]:
    return item, Instruction.from_item(item)


def _archived_handshake(item: Item) -> tuple[str, int]:
    source, _, at = handshake_in(item)
    if at > item.timestamp + _DAY_NS:
        raise MessageError("time", f"{item.key}: its time {at} is a day or more after it was written")
    return source, at
