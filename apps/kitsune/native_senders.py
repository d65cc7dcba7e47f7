"""`Senders` on the C ledger: equal results, no Python object a packet."""

from collections import deque
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from apps.kitsune import conversations, senders
from apps.kitsune.kernel import Columns, Kernel
from apps.kitsune.ledger import SwitchNumbers, check, rows_of, seed
from apps.kitsune.roles import Roles
from apps.kitsune.senders import AnomalousSecond, Evidence, Identity, SenderRecord, Senders, Tally

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
_MAC: Final = (1 << 48) - 1
_WHAT: Final = "senders"


class NativeSenders(Senders):
    """Assigns scored packets to responsible senders and closes seconds as capture time passes them.

    Args:
        kernel: the C kernel.
        roles: as learnt before; then training is over.
    """

    def __init__(self, kernel: Kernel, roles: Roles | None = None) -> None:
        super().__init__(roles)
        self._kernel, self._lib = kernel, kernel.lib
        limits = {
            "most_senders": senders.MOST_SENDERS,
            "most_conversations": conversations.MOST,
            "hot_packets": senders.HOT_PACKETS,
            "replies_per_packet": conversations.REPLIES_PER_PACKET,
            "hot_share": senders.HOT_SHARE,
        }
        state = self._lib.senders_new(kernel.ffi.new("SenderLimits *", limits), roles is None, seed())
        if state == kernel.ffi.NULL:
            raise MemoryError("senders: no memory for their tables")
        self._state = kernel.ffi.gc(state, self._lib.senders_free)
        self._switches = SwitchNumbers()
        self._history: dict[Identity, deque[int]] = {}
        """Anomalous seconds of senders that had some."""
        self._kept: dict[int, Sequence[Any]] = {}
        """Evidence of the open second, by number of the batch."""
        self._full: npt.NDArray[np.uint64] = np.zeros(0, np.uint64)
        """MACs behind which no more addresses are remembered."""

    @classmethod
    def restored(cls, state: dict[str, Any] | None, kernel: Kernel) -> "NativeSenders":
        """From what `to_state` returned; None: training is over all the same.

        Raises:
            KeyError, TypeError, ValueError: the state is not one.
        """
        former = Senders.from_state(state)
        self = cls(kernel, former.roles)
        for record in former.known():
            words = np.array(self._words(record.identity, new=True), dtype=np.uint64)
            pointer = kernel.pointer("uint64_t", words)
            check(
                self._lib.senders_know(
                    self._state, pointer, record.training_rate, record.training_destinations
                ),
                _WHAT,
            )
        return self

    def add(
        self,
        batch: Columns,
        switch: str,
        *,
        scores: npt.NDArray[np.float64],
        trained: int,
        line: float,
        evidence: Evidence,
    ) -> list[AnomalousSecond]:
        """As `Senders.add`."""
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
            rows.pointer,
            rows.count,
            trained,
            number,
            self._kernel.pointer("double", scores),
            line,
            self._kernel.pointer("int32_t", peaks),
            self._kernel.pointer("long", kept),
        )
        check(code, _WHAT)
        hot = self._take_events(evidence)
        count, newest, oldest = kept.tolist()
        if count:
            self._kept[newest] = evidence(peaks[:count])
        for number in [number for number in self._kept if number < oldest]:
            del self._kept[number]
        return hot

    def finish(self) -> list[AnomalousSecond]:
        """The capture has ended: closes the second that is still open."""
        check(self._lib.senders_finish(self._state), _WHAT)
        hot = self._take_events(lambda rows: rows.tolist())
        self._kept.clear()
        return hot

    def rates(self, identity: Identity) -> tuple[int, int]:
        """Packets of a sender in the open second, and the highest of any second of training."""
        if identity[0] not in self._switches.names:
            return 0, 0
        words, found = np.array(self._words(identity), dtype=np.uint64), np.zeros(2, np.int64)
        pointer = self._kernel.pointer("uint64_t", words)
        self._lib.senders_rates(self._state, pointer, self._kernel.pointer("int64_t", found))
        now, training = found.tolist()
        return now, training

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
        hot: list[AnomalousSecond] = []
        count = self._kernel.ffi.new("long *")
        pointer = self._lib.senders_events(self._state, count)
        if not count[0]:
            return hot
        events = np.frombuffer(self._kernel.ffi.buffer(pointer, count[0] * _EVENT.itemsize), _EVENT)
        for event in self._worth(events).tolist():
            what, kept_in, kept_at, row, *rest = event
            identity = self._identity(rest[:4])
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
                proof = evidence(np.array([row], np.int32))[0] if row >= 0 else self._kept[kept_in][kept_at]
                hot.append(self._anomalous(identity, rest[4:], proof))
        return hot

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
        self._training = False
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
        history.append(second)
        while history[0] <= second - senders.HISTORY_S:
            history.popleft()
        record = SenderRecord(identity, rate, hosts, second, history)
        tally = Tally(
            packets=packets, over=over, peak=peak, first_over=first_over, counted=destinations, evidence=proof
        )
        return AnomalousSecond(second, record, tally, len(history))


def senders_of(kernel: Kernel | None) -> Senders:
    """On the C kernel, or its Python twin without one."""
    return Senders() if kernel is None else NativeSenders(kernel)


def restored_senders(state: dict[str, Any] | None, kernel: Kernel | None) -> Senders:
    """From a model file; raises KeyError, TypeError or ValueError."""
    return Senders.from_state(state) if kernel is None else NativeSenders.restored(state, kernel)
