"""What a host sends to another within a second, beside what comes back.  Pure; `behaviour.c` does the same."""

from dataclasses import dataclass
from typing import Final

REPLIES_COUNT: Final = 10
"""One reply makes up for this many packets: bulk transfers are acknowledged now and then."""
OPENING: Final = 7 << 24
"""SYNs, as a kind of one-way traffic beside the protocols."""


@dataclass(slots=True)
class Exchange:
    """One direction between two hosts, in one second."""

    second: int = -1
    out: int = 0
    """Packets but SYNs."""
    back: int = 0
    """Packets of the other, but refusals and SYN-ACKs, which a flooded host sends as well."""
    before: int = 0
    """The same of the second before: who ends a conversation may do so a little later than the other."""
    syns: int = 0
    due: int = 0
    syns_due: int = 0

    def sent(self, second: int, *, opening: bool, all_counts: bool) -> int | None:
        """Count a packet.

        Args:
            second: of capture time.
            opening: it is a SYN.
            all_counts: return every count.

        Returns:
            Packets without an answer, or SYNs that nothing followed; None while it has hardly grown.
        """
        if self.second != second:
            self.before = self.back if self.second == second - 1 else 0
            self.second = second
            self.out = self.back = self.due = self.syns = self.syns_due = 0
        if opening:
            self.syns += 1
            # who opens a connection that comes about goes on in it
            alone, due = self.syns - self.out, self.syns_due
        else:
            self.out += 1
            alone, due = self.out - REPLIES_COUNT * (self.back + self.before), self.due
        if all_counts:
            return alone
        if alone < due:
            return None
        due = alone + max(1, alone // 8)
        if opening:
            self.syns_due = due
        else:
            self.due = due
        return alone
