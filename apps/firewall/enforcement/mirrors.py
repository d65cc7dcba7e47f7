"""Switches that see copies only, as behind a mirror port: nothing that they drop stops anything.

A decision about such a switch is a dry run, and says why.  One for all switches is, where all of them are mirrors.
Pure.
"""

from collections.abc import Collection
from typing import Final

from msgspec import structs

from apps.messages import Decision

COPIES: Final = "; would only: the switch sees copies, so nothing can be stopped there"
MOST_MIRRORS: Final = 256
"""As many as switches are connected at a time; the one heard of longest ago is forgotten."""
_EVERY_SWITCH: Final = ("", "*")


class Mirrors:
    """The mirrors among the connected switches."""

    def __init__(self, *, elsewhere: bool = False) -> None:
        self._mirrors: dict[str, None] = {}
        """The one heard of last is the last."""
        self._elsewhere = elsewhere
        """Enforcers that are no switches carry blocks out, whatever the switches see."""

    def __contains__(self, switch: str) -> bool:
        return switch in self._mirrors

    def __len__(self) -> int:
        return len(self._mirrors)

    def note(self, switch: str, *, mirror: bool) -> None:
        """Remember whether a switch sees copies only."""
        self._mirrors.pop(switch, None)
        if mirror:
            self._mirrors[switch] = None
        while len(self._mirrors) > MOST_MIRRORS:
            del self._mirrors[next(iter(self._mirrors))]

    def marked(self, decision: Decision, connected: Collection[str]) -> Decision:
        """The decision, as a dry run where no switch that could carry it out sees more than copies."""
        all_copies = bool(connected) and self._mirrors.keys() >= set(connected)
        if decision.switch not in self._mirrors and not (decision.switch in _EVERY_SWITCH and all_copies):
            return decision
        if self._elsewhere and decision.action in ("block", "unblock"):
            return decision
        said = decision.reason.endswith(COPIES)
        reason = decision.reason if said or decision.dry_run else decision.reason + COPIES
        return structs.replace(decision, dry_run=True, reason=reason)
