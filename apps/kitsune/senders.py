"""From scores to anomalous seconds of senders, counted in C (`senders.c`): no Python object a packet.

A sender is an ingress port, a MAC and an address.  A second of capture time is anomalous for a sender when
at least three, and at least half, of the packets for which it is responsible score at or above the threshold.  The
initiator of a conversation is responsible for the replies, so that a flood's victim is not blocked: a reply is a
TCP SYN-ACK or RST, an ICMP error, or a UDP packet back, soon after the initiator's last packet.
"""

import math
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from apps.kitsune.blocked import Blocked
from apps.kitsune.kernel import Columns, Kernel, load_kernel
from apps.kitsune.kernel_rows import SwitchNumbers, check, rows_of, seed
from apps.kitsune.roles import Roles

ANOMALOUS_PACKETS: Final = 3
ANOMALOUS_SHARE: Final = 0.5
HISTORY_S: Final = 10
MOST_SENDERS: Final = 131_072
"""Beyond this number, senders unknown to training and silent for `HISTORY_S` are forgotten."""
MOST_CONVERSATIONS: Final = 65_536
REPLIES_PER_PACKET: Final = 10
"""An initiator is responsible for at most this many replies per packet of its own; further ones are a flood."""
Address = tuple[int, int, int]
"""IP version, upper and lower half of the address."""
Identity = tuple[str, int, int, Address]
"""Switch, ingress port, MAC, address."""
Evidence = Callable[[npt.NDArray[np.int32]], Sequence[Any]]
"""Rows of the batch to the data that explain their scores, copied, because the batch is about to be released."""

_SEEN, _TOWARDS, _TRAINED, _CLOCK_SET_BACK, _ANOMALOUS, _FORGOTTEN = range(6)
_EVENT: Final = np.dtype(
    [
        *((name, "i4") for name in ("what", "kept_in", "kept_at", "row")),
        *((name, "u8") for name in ("ends", "where", "hi", "lo")),
        *((name, "i8") for name in ("second", "packets", "over", "destinations")),
        ("first_over", "u8"),
        *(("training_rate", "i8"), ("training_destinations", "i8"), ("peak", "f8")),
    ]
)
"""A `SenderEvent` of C."""
_ROW: Final = 3
_MAC: Final = (1 << 48) - 1
_WHAT: Final = "senders"


@dataclass(slots=True)
class SenderRecord:
    """The history of a sender."""

    identity: Identity
    training_rate: int = 0
    training_destinations: int = 0
    last_second: int = 0
    anomalous: deque[int] = field(default_factory=deque)


@dataclass(slots=True)
class Tally:
    """The counts of one sender in one second."""

    packets: int = 0
    over: int = 0
    peak: float = -math.inf
    first_over: int = 0
    hosts: int = 0
    """Number of different destinations."""
    evidence: Any = None


class AnomalousSecond(NamedTuple):
    """A sender's second in which too many packets scored at or above the threshold."""

    second: int
    record: SenderRecord
    tally: Tally
    anomalous_seconds: int
    """Anomalous seconds among the last ten, this one included."""


class Senders:
    """Assigns scored packets to responsible senders and closes seconds as capture time passes them.

    Args:
        kernel: None loads the one that was built.
        roles: as learnt before; then training is over.
    """

    def __init__(self, kernel: Kernel | None = None, roles: Roles | None = None) -> None:
        kernel = kernel or load_kernel()
        self.roles = roles or Roles()
        self.clock_jumps = 0
        self.blocked = Blocked()
        self._kernel, self._lib = kernel, kernel.lib
        limits = {
            "most_senders": MOST_SENDERS,
            "most_conversations": MOST_CONVERSATIONS,
            "anomalous_packets": ANOMALOUS_PACKETS,
            "replies_per_packet": REPLIES_PER_PACKET,
            "anomalous_share": ANOMALOUS_SHARE,
        }
        state = self._lib.senders_new(kernel.ffi.new("SenderLimits *", limits), roles is None, seed())
        if state == kernel.ffi.NULL:
            raise MemoryError("senders: no memory for their tables")
        self._state = kernel.ffi.gc(state, self._lib.senders_free)
        self._switches = SwitchNumbers()
        self._history: OrderedDict[Identity, deque[int]] = OrderedDict()
        """Anomalous seconds of senders that had some within `HISTORY_S`; who had the last one is at the end."""
        self._kept: dict[int, Sequence[Any]] = {}
        """Evidence of the open second, by number of the batch."""
        self._full: npt.NDArray[np.uint64] = np.zeros(0, np.uint64)
        """MACs behind which no more addresses are remembered."""

    def to_state(self) -> dict[str, Any]:
        """The learnt senders as plain values."""
        trained = [record for record in self.known() if record.training_rate]
        return {
            "roles": self.roles.to_state(),
            "records": [[r.identity, r.training_rate, r.training_destinations] for r in trained],
        }

    @classmethod
    def from_state(cls, state: dict[str, Any] | None, kernel: Kernel | None = None) -> "Senders":
        """Senders from a saved model (None: it has none); training is complete.

        Raises:
            KeyError, TypeError, ValueError: the state is not one.
        """
        self = cls(kernel, Roles.from_state(state["roles"]) if state else Roles())
        for (switch, port, mac, (version, hi, lo)), rate, destinations in state["records"] if state else ():
            identity = (str(switch), int(port), int(mac), (int(version), int(hi), int(lo)))
            self._know(identity, int(rate), int(destinations))
        return self

    def _know(self, identity: Identity, rate: int, destinations: int) -> None:
        words = np.array(self._words(identity, new=True), dtype=np.uint64)
        pointer = self._kernel.pointer("uint64_t", words)
        check(self._lib.senders_know(self._state, pointer, rate, destinations), _WHAT)
        self.roles.see(identity[2], identity[3])

    def add(
        self,
        batch: Columns,
        switch: str,
        *,
        scores: npt.NDArray[np.float64],
        trained: int,
        threshold: float,
        evidence: Evidence,
    ) -> list[AnomalousSecond]:
        """Take a batch of which the first `trained` packets were training; returns the seconds that became anomalous."""
        rows = rows_of(self._kernel, batch)
        if not rows.count:
            return []
        number = self._switches.number(switch)
        blocks = self._switches.changed_blocks(self.blocked)
        if blocks is not None:
            code = self._lib.senders_blocks(
                self._state, self._kernel.pointer("uint64_t", blocks), len(blocks)
            )
            check(code, _WHAT)
        scores = np.ascontiguousarray(scores, dtype=np.float64)
        peaks, kept = np.empty(rows.count, np.int32), np.zeros(3, np.int64)
        code = self._lib.senders_add(
            self._state,
            rows.decoded,
            rows.count,
            trained,
            number,
            self._kernel.pointer("double", scores),
            threshold,
            self._kernel.pointer("int32_t", peaks),
            self._kernel.pointer("long", kept),
        )
        check(code, _WHAT)
        seconds = self._take_events(evidence)
        count, newest, oldest = kept.tolist()
        if count:
            self._kept[newest] = evidence(peaks[:count])
        for number in [number for number in self._kept if number < oldest]:
            del self._kept[number]
        return seconds

    def finish(self) -> list[AnomalousSecond]:
        """The capture has ended: closes the second that is still open."""
        check(self._lib.senders_finish(self._state), _WHAT)
        seconds = self._take_events(lambda rows: rows.tolist())
        self._kept.clear()
        return seconds

    def rates(self, identity: Identity) -> tuple[int, int]:
        """Packets of a sender in the open second, and the highest of any second of training."""
        if identity[0] not in self._switches.names:
            return 0, 0
        found = self._kernel.ffi.new("int64_t[2]")
        self._lib.senders_rates(self._state, self._words(identity), found)
        return found[0], found[1]

    def known(self) -> list[SenderRecord]:
        """All senders that are remembered."""
        null = self._kernel.ffi.NULL
        count = self._lib.senders_known(self._state, null, null, 0)
        who, numbers = np.zeros((count, 4), np.uint64), np.zeros((count, 3), np.int64)
        pointers = self._kernel.pointer("uint64_t", who), self._kernel.pointer("int64_t", numbers)
        self._lib.senders_known(self._state, *pointers, count)
        return [
            SenderRecord(self._identity(words), *row)
            for words, row in zip(who.tolist(), numbers.tolist(), strict=True)
        ]

    def _words(self, identity: Identity, *, new: bool = False) -> tuple[int, ...]:
        switch, port, mac, (version, hi, lo) = identity
        number = self._switches.number(switch) if new else self._switches.names.index(switch)
        return mac | port << 48, number | version << 16, hi, lo

    def _identity(self, words: Sequence[int]) -> Identity:
        ends, where, hi, lo = words
        return self._switches.names[where & 0xFFFF], ends >> 48, ends & _MAC, (where >> 16 & 0xFF, hi, lo)

    def _take_events(self, evidence: Evidence) -> list[AnomalousSecond]:
        seconds: list[AnomalousSecond] = []
        count = self._kernel.ffi.new("long *")
        pointer = self._lib.senders_events(self._state, count)
        if not count[0]:
            return seconds
        events = np.frombuffer(self._kernel.ffi.buffer(pointer, count[0] * _EVENT.itemsize), _EVENT)
        told = self._worth(events).tolist()
        peaks = [event[_ROW] for event in told if event[0] == _ANOMALOUS and event[_ROW] >= 0]
        proofs = iter(evidence(np.array(peaks, np.int32)) if peaks else ())
        for event in told:
            what, kept_in, kept_at, row, ends, where, hi, lo, *numbers = event
            identity = self._identity((ends, where, hi, lo))
            if what == _SEEN:
                self._see(identity)
            elif what == _TOWARDS:
                self.roles.towards(identity[2], identity[3])
            elif what == _TRAINED:
                self._end_training()
            elif what == _CLOCK_SET_BACK:
                self.clock_jumps += 1
                self._history.clear()
            elif what == _FORGOTTEN:
                self._history.pop(identity, None)
            else:
                proof = next(proofs) if row >= 0 else self._kept[kept_in][kept_at]
                seconds.append(self._anomalous(identity, numbers, proof))
        return seconds

    def _worth(self, events: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
        """Without new addresses behind MACs that have as many as are remembered: floods are full of them."""
        if not len(self._full):
            return events
        worth: npt.NDArray[np.void] = events[
            (events["what"] != _SEEN) | ~np.isin(events["ends"] & np.uint64(_MAC), self._full)
        ]
        return worth

    def _see(self, identity: Identity) -> None:
        mac = identity[2]
        self.roles.see(mac, identity[3])
        if self.roles.is_full(mac) and mac not in self._full:
            self._full = np.append(self._full, np.uint64(mac))

    def _end_training(self) -> None:
        null = self._kernel.ffi.NULL
        count = self._lib.senders_speakers(self._state, null, null, 0)
        who, numbers = np.zeros((count, 3), np.uint64), np.zeros((count, 4), np.int64)
        pointers = self._kernel.pointer("uint64_t", who), self._kernel.pointer("int64_t", numbers)
        self._lib.senders_speakers(self._state, *pointers, count)
        for (version, hi, lo), (packets, multicast, dns, dhcp) in zip(
            who.tolist(), numbers.tolist(), strict=True
        ):
            self.roles.spoke((version, hi, lo), packets, multicast, dns=bool(dns), dhcp=bool(dhcp))
        self.roles.close_training()

    def _anomalous(self, identity: Identity, numbers: Sequence[Any], proof: Any) -> AnomalousSecond:
        second, packets, over, destinations, first_over, rate, hosts, peak = numbers
        history = self._history.setdefault(identity, deque())
        self._history.move_to_end(identity)
        history.append(second)
        while history[0] <= second - HISTORY_S:
            history.popleft()
        self._forget_until(second - HISTORY_S)
        record = SenderRecord(identity, rate, hosts, second, history)
        tally = Tally(packets, over, peak, first_over, destinations, proof)
        return AnomalousSecond(second, record, tally, len(history))

    def _forget_until(self, second: int) -> None:
        """Senders whose last anomalous second is no later: in a network that meets ever new ones they would pile up."""
        while (former := next(iter(self._history.values()), None)) is not None:
            if former and former[-1] > second:
                return
            self._history.popitem(last=False)
