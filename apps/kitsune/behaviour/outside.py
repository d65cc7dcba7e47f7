"""Whether the outside can be reached at all.  Pure; `behaviour.c` does the same.

While an uplink or a provider is down every contact with the outside fails, whoever makes it, so that it fails says
nothing about who makes it.  Two signs of that, both against training:

    silence    nothing has come from outside for longer than at any time of training
    in vain    several other hosts have failed to reach anybody new outside, and since then nobody has

Floods are counted all the same: one that fills the uplink silences the outside as well.
"""

import math
from typing import Final

from apps.kitsune.behaviour.rows import SenderId, parts_of
from apps.kitsune.roles import is_inside

NEVER: Final = -1.0
"""As a longest silence: training heard nothing from outside, so that silence means nothing."""
OTHERS: Final = 3
"""Number of other hosts that must have failed: two may be infected by a third."""
IN_VAIN_S: Final = 600.0
"""Seconds for which failures are one outage, unless somebody is reached."""


class Outside:
    """Follows packets from outside and contacts with it; in capture order."""

    def __init__(self) -> None:
        self.longest = NEVER
        """The longest silence of training, seconds."""
        self.reachable = False
        """Somebody reached the outside in training."""
        self._learning = True
        self._heard = False
        self._last = -math.inf
        self._gap = 0.0
        self._in_vain: set[SenderId] = set()
        self._since = 0.0

    def see(self, time: float, source: int) -> None:
        """A packet of a source, 0 for none, at a time in seconds."""
        if self._last == -math.inf:
            self._last = time
        if not source or is_inside(parts_of(source)):
            return
        self._heard = True
        self._gap = max(self._gap, time - self._last)
        self._last = max(self._last, time)

    def close(self, time: float) -> None:
        """Training ends at this time."""
        self._learning = False
        self.longest = max(self._gap, time - self._last) if self._heard else NEVER

    def restore(self, longest: float, reachable: bool) -> None:
        """A saved training has taught this; raises `ValueError`."""
        if not (longest >= 0 or longest == NEVER):
            raise ValueError(f"a silence of {longest} s")
        self._learning, self.longest, self.reachable = False, longest, reachable

    def explains(self, failed: bool, sender: SenderId, target: int, time: float) -> bool:
        """Whether a contact that has ended failed because nobody reaches the outside.

        Args:
            failed: whether it failed or succeeded.
            sender: who made it, from inside.
            target: with whom.
            time: when it ended, seconds.
        """
        if is_inside(parts_of(target)) or not is_inside(parts_of(sender[3])):
            return False
        if not failed:
            self._in_vain.clear()
            self.reachable |= self._learning
            return False
        if self._learning:
            return False
        if self._in_vain and time - self._since > IN_VAIN_S:
            self._in_vain.clear()
        if not self._in_vain:
            self._since = time
        if len(self._in_vain) <= OTHERS:
            self._in_vain.add(sender)
        if self.longest >= 0 and time - self._last > self.longest:
            return True
        return self.reachable and len(self._in_vain) > OTHERS
