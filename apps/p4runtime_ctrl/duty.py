"""Whether a worker speaks for its switch, where several controllers divide the switches.  Pure.

    given by the Coordinator      ─► granted   ─┐
    the switch's arbitration      ─► backup    ─┼─► speaks: states, confirmations
    states from other controllers ─► elsewhere ─┘

Every controller has a worker for each switch, and hears every decision.  The one that is primary writes to the switch
and speaks for it; while none is, the one that the Coordinator gave the switch to last.  One that has lost its connection
learns from the others' states that the switch is not away.
"""

from collections.abc import Callable, Sequence
from typing import Final

from apps.messages import Confirmation
from apps.p4runtime_ctrl.arrivals import SwitchTold

_WITHHELD_S: Final = 2.0
_TOLD_S: Final = 3.0
"""A primary controller says how its switch is every second."""
_MOST: Final = 10_000


class SwitchDuty:
    """Of one worker and one switch.

    Args:
        instance: tells the id of this instance.
        divided: several controllers divide the switches; otherwise a worker always speaks.
    """

    def __init__(self, instance: Callable[[], str], *, divided: bool) -> None:
        self._instance = instance
        self.divided = divided
        self.granted = not divided
        """The Coordinator gave the switch to this controller."""
        self.backup = False
        """The switch said that another controller is primary."""
        self._answers = not divided
        """It was granted, and no other controller was primary since."""
        self.before: SwitchTold | None = None
        """What another controller said last while it was primary."""
        self._other = ("", 0.0)
        """The instance that said so, and when."""
        self._withheld: list[Confirmation] = []
        self._since = 0.0

    def give(self, *, granted: bool) -> None:
        """The Coordinator has given the switch to this controller, or taken it away.

        Args:
            granted: given.
        """
        self.granted = granted
        self._answers = self._answers or granted

    def stand_back(self) -> None:
        """Another controller is primary."""
        self.backup, self._answers = True, False
        self.settled()

    def heard(self, told: SwitchTold, instance: str, now: float) -> None:
        """Another controller has said how the switch is.

        Args:
            told: its state.
            instance: who said it.
            now: seconds, monotonic.
        """
        if told.primary:
            self.before, self._other, self._answers = told, (instance, now), False
        elif self._other[0] == instance:
            self._other = ("", 0.0)

    def elsewhere(self, now: float) -> str:
        """The instance that says that it is primary; empty: none does.

        Args:
            now: seconds, monotonic.
        """
        instance, at = self._other
        return instance if instance and now - at < _TOLD_S else ""

    def speaks(self, now: float, *, primary: bool) -> bool:
        """Whether this worker is the one to say how the switch is.

        Args:
            now: seconds, monotonic.
            primary: it may write to the switch.
        """
        waits = self.backup or self.elsewhere(now)
        return not self.divided or primary or ((self.granted or self._answers) and not waits)

    def owner(self, now: float, *, primary: bool) -> str:
        """The instance that is primary; empty: none is, as far as this one knows, or the switches are not divided.

        Args:
            now: seconds, monotonic.
            primary: this one is.
        """
        if not self.divided:
            return ""
        if primary:
            return self._instance()
        return self.elsewhere(now) or ("another" if self.backup else "")

    def withhold(self, confirmations: Sequence[Confirmation], now: float) -> None:
        """The switch refused writes under this election id, or is away: wait for somebody to say who is primary.

        Another primary carries the same decisions out and confirms them; what this one says last must not be that they
        failed.

        Args:
            confirmations: of the writes that failed.
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
