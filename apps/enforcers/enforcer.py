"""What an enforcer must be able to do.  Pure: the interface and its errors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from apps.enforcers.desired_blocks import DesiredBlock


class EnforcerAway(Exception):
    """It cannot be asked now: no right, no program, no answer.  What was asked is tried again."""


@dataclass(frozen=True)
class HeldCount:
    """A block that stands: packets and bytes that it has dropped since it stands."""

    packets: int = 0
    bytes: int = 0


class Enforcer(Protocol):
    """Adds, removes, lists back; called from one thread.  Every method raises `EnforcerAway` only.

    Until the first `allow`, history is unknown: `change` leaves alone what it is not told of, and `held` is not called.
    """

    def change(self, add: Sequence[DesiredBlock], remove: Sequence[DesiredBlock]) -> Mapping[str, str]:
        """Add and remove blocks; adding what stands changes its end.

        Args:
            add: blocks that shall stand.
            remove: blocks that shall not; those that do not stand are no error.

        Returns:
            Why, by decision id, of those that were refused for good.
        """
        ...

    def allow(self, entries: Sequence[str]) -> None:
        """Senders that no block may touch, whatever else stands: the whole list, in force with the next `change`."""
        ...

    def held(self, desired: Sequence[DesiredBlock]) -> Mapping[str, HeldCount]:
        """Read back which of these stand; what else stands is removed."""
        ...

    def end(self, desired: Sequence[DesiredBlock]) -> None:
        """The app ends; what stands is left or removed, as the settings say."""
        ...
