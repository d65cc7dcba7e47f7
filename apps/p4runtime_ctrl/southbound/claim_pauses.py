"""When an active controller claims a switch once more from another one.  Pure."""

from typing import Final

_FIRST_S: Final = 1.0
_LONGEST_S: Final = 60.0
_SOON: Final = 4
"""A claim within so many pauses of the one before is answered by a longer pause."""


class ClaimPauses:
    """Pauses between claims: a second, and twice as long each time the switch is lost again soon.

    A standby gives way to the first claim.  Two active controllers of one rank, which are a mistake in their settings,
    would take the switch from each other for ever; so each comes to keep it for longer and longer.
    Not `due.backoff`: the switch says that a claim has succeeded also where it will be lost again in a second, so a claim
    counts as good only once it has lasted.
    """

    def __init__(self) -> None:
        self._claimed = float("-inf")
        self._pause = _FIRST_S

    def due(self, now: float) -> bool:
        """Whether to claim the switch now; if so, that counts as a claim.

        Args:
            now: seconds, monotonic.
        """
        since = now - self._claimed
        if since <= self._pause:
            return False
        soon = since < _SOON * self._pause
        self._pause = min(2 * self._pause, _LONGEST_S) if soon else _FIRST_S
        self._claimed = now
        return True
