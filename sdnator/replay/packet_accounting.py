"""State of every packet of a replay: in flight, scored, dropped or not copied.  Pure.

    sent ──► in flight ──┬─ verdict 'neither copied nor forwarded' ──► dropped
                         ├─ verdict 'forwarded only' ────────────────► not copied
                         └─ verdict 'copied', then a score ──────────► train or scored

A switch behind an interface gives no verdicts.  There the order decides: a packet that is overtaken by the
score of a later one made no copy, so it was dropped (or lost, which the sequence numbers of the packet-ins
show).  For the last ones, which nothing overtakes, the switch's drop counters decide.
"""

import enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

COPIED: Final = 1
FORWARDED: Final = 2


class PacketState(enum.IntEnum):
    """State of a packet."""

    IN_FLIGHT = 0
    TRAIN = 1
    SCORED = 2
    DROPPED = 3
    NOT_COPIED = 4


class PacketAccounting:
    """The state and score of each packet, by its index in the capture.

    Args:
        packets: how many packets the capture has.
        verdicts: False for a switch that gives none: overtaken packets count as dropped.
        by_digest: True where headers come by digest: a packet that made no copy may be scored nevertheless.
    """

    def __init__(self, packets: int, *, verdicts: bool = True, by_digest: bool = False) -> None:
        self._verdicts = verdicts
        self._by_digest = by_digest
        self._first_arrival: int | None = 0 if verdicts else None
        self._overtaken = 0
        self.state: NDArray[np.uint8] = np.zeros(packets, np.uint8)
        self.score: NDArray[np.float64] = np.full(packets, np.nan)
        self.sent = 0
        """Packets sent into the switch so far: indices 0 to sent-1."""
        self.judged = 0
        """Packets whose verdict the switch has given."""
        self.decided = 0
        """Packets that are no longer in flight."""

    @property
    def first_arrival(self) -> int:
        """Arrival number of the capture's first packet at the switch."""
        return self._first_arrival or 0

    @property
    def in_flight(self) -> int:
        """Packets sent that are neither scored, dropped nor known to be not copied."""
        return self.sent - self.decided

    def send(self, packets: int) -> None:
        """Note that the next `packets` packets were sent."""
        self.sent += packets

    def judge(self, verdicts: bytes) -> None:
        """Take the switch's verdicts on the next packets, in order (bit 0 copied, bit 1 forwarded)."""
        if not verdicts:
            return
        given = np.frombuffer(verdicts, np.uint8)
        states = self.state[self.judged : self.judged + len(given)]
        if len(states) < len(given):
            raise ValueError(
                f"{len(given)} verdicts from packet {self.judged} on, only {len(states)} packets left"
            )
        # A score may overtake its verdict: the score counts.
        undecided = states == PacketState.IN_FLIGHT
        dropped = undecided & ((given & (COPIED | FORWARDED)) == 0)
        not_copied = undecided & ((given & COPIED) == 0) & ~dropped & (not self._by_digest)
        states[dropped] = PacketState.DROPPED
        states[not_copied] = PacketState.NOT_COPIED
        self.judged += len(given)
        self.decided += int(dropped.sum() + not_copied.sum())

    def scored(
        self, arrival: NDArray[np.uint64], score: NDArray[np.float64], trained: NDArray[np.bool_]
    ) -> None:
        """Take scores of packets, by their arrival number at the switch.

        The first packet of the capture has arrival number 0 on a switch that gives verdicts; on others
        the first score tells where the numbers begin.
        """
        if not len(arrival):
            return
        if self._first_arrival is None:
            self._first_arrival = int(arrival[0])
        index = arrival.astype(np.int64) - self._first_arrival
        if int(index.max()) >= len(self.state) or int(index.min()) < 0:
            raise ValueError(
                f"a score for packet {int(index.max())} of {len(self.state)}: another sender feeds this switch"
            )
        fresh = self.state[index] == PacketState.IN_FLIGHT
        self.state[index] = np.where(trained, PacketState.TRAIN, PacketState.SCORED)
        self.score[index] = score
        self.decided += int(fresh.sum())
        if not self._verdicts:
            self._drop_before(int(index[-1]))

    def settle_counted(self, drops: int) -> None:
        """Given the switch's drop count: if it accounts for all packets in flight, they were dropped."""
        if (
            not self._verdicts
            and self.in_flight
            and drops == self.count(PacketState.DROPPED) + self.in_flight
        ):
            self._drop_before(self.sent)

    def settle(self) -> None:
        """The loop is silent: on a switch without verdicts, packets in flight were dropped."""
        if not self._verdicts:
            self._drop_before(self.sent)

    def _drop_before(self, end: int) -> None:
        states = self.state[self._overtaken : end]
        overtaken = states == PacketState.IN_FLIGHT
        states[overtaken] = PacketState.DROPPED
        self.decided += int(overtaken.sum())
        self._overtaken = max(self._overtaken, end)

    def count(self, state: PacketState) -> int:
        """Packets in a state, of those sent."""
        return int(np.count_nonzero(self.state[: self.sent] == state))
