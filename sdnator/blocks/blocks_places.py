"""Where decisions are in force: the last answer of every enforcer, as Data Archives have it."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from msgspec import structs

from apps.enforcement import CONFIRMED, SWITCHES
from apps.messages import Confirmation, Decision, MessageError, one_line, sender_of
from due import Item
from sdnator.blocks.blocks_archive import find

STANDING: Final = ("installed", "exists")
_ASKED_AT_ONCE: Final = 500
_CAUSE: Final = 100


@dataclass(frozen=True)
class PlaceAnswer:
    """What one enforcer said last of a decision."""

    enforcer: str
    place: str
    state: str
    cause: str

    @property
    def stands(self) -> bool:
        """Whether the decision is in force there."""
        return self.state in STANDING

    def where(self) -> str:
        """The switch, or the enforcer and its place."""
        return f"switch {self.place}" if self.enforcer == SWITCHES else f"{self.enforcer} {self.place}"

    def to_value(self) -> dict[str, str]:
        """As plain values."""
        return {"enforcer": self.enforcer, "place": self.place, "state": self.state, "cause": self.cause}


Answers = Mapping[str, tuple[PlaceAnswer, ...]]
"""By decision id."""


def answers_of(decisions: Collection[str], archive: str) -> Answers:
    """The last answer of every enforcer to each decision; raises `BadInput`."""
    names, items = list(decisions), list[Item]()
    for first in range(0, len(names), _ASKED_AT_ONCE):
        asked = {"$in": names[first : first + _ASKED_AT_ONCE]}
        items += find(archive, {"dataKey": f"{CONFIRMED}.*.*", "value.id": asked})
    return last_answers(items)


def last_answers(items: Iterable[Item]) -> Answers:
    """The last answer of every enforcer, of archived confirmations; malformed ones are left out."""
    found: dict[str, dict[tuple[str, str], PlaceAnswer]] = {}
    for item in sorted(items, key=lambda item: (item.timestamp, item.sequence)):
        try:
            said, app = Confirmation.from_value(item.value), sender_of(item)
        except MessageError:
            continue
        answer = PlaceAnswer(app, said.switch, said.state, said.cause)
        found.setdefault(said.id, {})[app, said.switch] = answer
    return {name: tuple(answers[each] for each in sorted(answers)) for name, answers in found.items()}


def action_word(decision: Decision, answers: Collection[PlaceAnswer]) -> str:
    """The action; `would …` for a dry run, and where no enforcer has it in force."""
    stands = any(answer.stands for answer in answers)
    lifts = decision.action.startswith("un")
    if lifts or stands:
        return decision.doing
    return structs.replace(decision, dry_run=True).doing


def places_words(decision: Decision, answers: Collection[PlaceAnswer]) -> str:
    """Where it is in force, who keeps it for later, and who has refused it and why."""
    if decision.dry_run:
        return "in force nowhere: a dry run"
    stands = [answer.where() for answer in answers if answer.stands]
    refused = [
        f"{answer.where()} refused it: {one_line(answer.cause)[:_CAUSE]}"
        for answer in answers
        if answer.state == "failed"
    ]
    waits = [
        f"{answer.where()} has it pending: {one_line(answer.cause)[:_CAUSE]}"
        for answer in answers
        if answer.state == "pending"
    ]
    words = f"in force: {', '.join(stands)}" if stands else "in force nowhere"
    if not answers:
        words += ", no enforcer has answered"
    return "; ".join([words, *waits, *refused])
