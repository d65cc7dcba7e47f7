"""Whether a worker speaks for its switch, where several controllers divide the switches.  Pure.

    given by the Coordinator ─► granted ─┐
    the switch's arbitration ─► backup  ─┴─► speaks: states, confirmations

Every controller has a worker for each switch, and hears every decision.  The one that is primary writes to the switch
and speaks for it; while none is, the one that the Coordinator gave the switch to.
"""

from collections.abc import Sequence
from typing import Final

from apps.messages import Confirmation

_WITHHELD_S: Final = 2.0
_MOST: Final = 10_000


class SwitchDuty:
    """Of one worker and one switch.

    Args:
        divided: several controllers divide the switches; otherwise a worker always speaks.
    """

    def __init__(self, *, divided: bool) -> None:
        self.divided = divided
        self.granted = not divided
        """The Coordinator gave the switch to this controller."""
        self.backup = False
        """The switch said that another controller is primary."""
        self._withheld: list[Confirmation] = []
        self._since = 0.0

    def speaks(self, *, primary: bool) -> bool:
        """Whether this worker is the one to say how the switch is.

        Args:
            primary: it may write to the switch.
        """
        return not self.divided or primary or (self.granted and not self.backup)

    def owner(self, given: str, me: str) -> str:
        """The instance that is primary while this one is not; empty: none is, as far as this one knows.

        Args:
            given: the instance that the Coordinator gave the switch to.
            me: this one.
        """
        if not self.backup:
            return ""
        return given if given != me and given else "another"

    def withhold(self, confirmations: Sequence[Confirmation], now: float) -> None:
        """The switch refused writes under this election id: wait for it to say who is primary.

        Another primary carries the same decisions out and confirms them; what this one says last must not be that they
        failed.

        Args:
            confirmations: of the refused writes.
            now: seconds, monotonic.
        """
        self._since = self._since if self._withheld else now
        self._withheld = [*self._withheld, *confirmations][-_MOST:]

    def settled(self) -> None:
        """The switch has said who is primary."""
        self._withheld = []

    def overdue(self, now: float) -> list[Confirmation]:
        """Confirmations that were withheld for too long, to be said after all.

        Args:
            now: seconds, monotonic.
        """
        if not self._withheld or now - self._since < _WITHHELD_S:
            return []
        told, self._withheld = self._withheld, []
        return told
