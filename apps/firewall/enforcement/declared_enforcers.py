"""Where each block is in force: what every declared enforcer has confirmed and counted, and how they are."""

from collections import OrderedDict
from collections.abc import Collection, Container, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import due
from apps.enforcement import ALLOWED, SWITCHES, AllowedEntries, EnforcementReport, place_text
from apps.incidents import MOST_PLACES
from apps.messages import Confirmation, State, one_line
from due import Engine

_REMEMBERED: Final = 65_536
"""Decisions that have not ended everywhere."""
_ENDED: Final = 1_024
"""Decisions whose drop counters may still come, though they have ended."""
_MOST_WATCHED: Final = 1_000
_STANDING: Final = ("installed", "exists")
_HELD: Final = (*_STANDING, "pending")
"""In force, or soon."""
_COMMANDED: Final = ("insert", "modify", "delete")


@dataclass(slots=True)
class _Places:
    states: dict[str, State] = field(default_factory=dict)
    """By place."""
    packets: dict[str, int] = field(default_factory=dict)
    answered: set[str] = field(default_factory=set)
    """Enforcers."""


class DeclaredEnforcers:
    """The enforcers that the settings name: their answers, what they count, and how they are.

    Args:
        engine: where the allow-list is written for those that are no switches.
        enforcers: app ids of those that take part.
    """

    def __init__(self, engine: Engine, enforcers: Collection[str]) -> None:
        self._engine = engine
        self._allowed: tuple[str, ...] | None = None
        self._problems: dict[str, str] = {}
        self._enforcers = frozenset(enforcers)
        self._known: OrderedDict[str, _Places] = OrderedDict()
        self._ended: OrderedDict[str, None] = OrderedDict()

    def __contains__(self, decision: object) -> bool:
        """Whether any enforcer has confirmed this decision, or counts its packets, and it has not ended."""
        return decision in self._known

    def __len__(self) -> int:
        return len(self._known)

    @property
    def elsewhere(self) -> bool:
        """Whether anything but switches carries blocks out."""
        return bool(self._enforcers - {SWITCHES})

    def follows(self, said: Confirmation, blocks: Container[str]) -> bool:
        """Whether an answer is about a decision: commands are answered under the same key.

        Args:
            said: the answer.
            blocks: ids of blocks in force; those of prefixes are carried out as commands.
        """
        return said.action not in _COMMANDED or said.id in blocks or said.id in self._known

    def confirmed(self, enforcer: str, said: Confirmation) -> bool:
        """Note an answer.

        Args:
            enforcer: app id of who answered.
            said: the answer.

        Returns:
            Whether it holds for the decision as a whole; what is pending is neither in force nor at its end.  One of
            several that refuses or removes it does not end it while others carry it out or have not answered; neither
            does one that ends it by its own clock, because the firewall extends or lifts it then.
        """
        places = self._of(said.id)
        places.answered.add(enforcer)
        name = place_text(enforcer, said.switch)
        if name in places.states or len(places.states) < MOST_PLACES:
            places.states[name] = said.state
        if said.state in _HELD:
            return True
        if enforcer != SWITCHES and said.state == "expired":
            return False
        stands = any(state in _HELD for state in places.states.values())
        over = not stands and (not self.elsewhere or places.answered >= self._enforcers)
        if over:
            self._end(said.id)
        return over or not self.elsewhere

    def in_force(self, decision: str) -> tuple[str, ...]:
        """Places in which a decision is in force, such as `nftables gateway`."""
        known = self._known.get(decision)
        return (
            tuple(sorted(name for name, state in known.states.items() if state in _STANDING)) if known else ()
        )

    def count(self, decision: str, enforcer: str, place: str, packets: int) -> int:
        """Note a drop counter; returns the sum over all places."""
        if decision in self._ended:
            return packets
        places = self._of(decision)
        name = place_text(enforcer, place)
        if name in places.packets or len(places.packets) < MOST_PLACES:
            places.packets[name] = packets
        return sum(places.packets.values())

    def tell_allowed(self, entries: Sequence[str]) -> None:
        """Write the whole allow-list, if it has changed and there are enforcers that need it."""
        if self.elsewhere and self._allowed != tuple(entries):
            self._allowed = tuple(entries)
            value = AllowedEntries(entries=self._allowed).to_value()
            self._engine.write(ALLOWED, value, [due.NO_WAIT])

    def news_of(self, report: EnforcementReport) -> str:
        """What operators should know of a report, in words; empty: nothing new."""
        where = place_text(report.enforcer, report.place)
        before = self._problems.get(where, "")
        if where in self._problems or len(self._problems) < _MOST_WATCHED:
            self._problems[where] = report.problem
        if report.problem == before or not report.problem:
            return ""
        return f"enforcer {where}: {one_line(report.problem)}"

    def health(self) -> dict[str, Any]:
        """Counters for the operator and for Prometheus."""
        return {
            "enforcers": len(self._enforcers),
            "enforcers_failing": sum(bool(each) for each in self._problems.values()),
        }

    def _end(self, decision: str) -> None:
        del self._known[decision]
        self._ended[decision] = None
        if len(self._ended) > _ENDED:
            self._ended.popitem(last=False)

    def _of(self, decision: str) -> _Places:
        self._ended.pop(decision, None)
        places = self._known.setdefault(decision, _Places())
        self._known.move_to_end(decision)
        if len(self._known) > _REMEMBERED:
            self._known.popitem(last=False)
        return places
