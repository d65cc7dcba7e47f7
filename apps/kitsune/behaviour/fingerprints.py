"""SYNs that no TCP stack sends: their sequence number is the address of their destination.  Pure.

Stacks choose the first sequence number by chance (RFC 6528), so that it is the destination's address once in 2^32 SYNs.
Mirai's scanner, and those made from it, send no others: they know the answers to their probes by it.  Training saw n
SYNs, k of which were like that, so another training is expected to see k + n / 2^32.  Among m senders, one weighs

    ln(m / (k + n / 2^32))

nats, as what exceeds everybody's highest count does by its rarity (`baseline`); and the next one as much again.

Source: Antonakakis et al., Understanding the Mirai Botnet, USENIX Security 2017, section 3.
"""

import math
from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Iterable
from typing import Any, Final

from apps.kitsune.behaviour.baseline import FORGOTTEN_AT_A_TIME, MOST_EVENTS, MOST_SUBJECTS
from apps.kitsune.behaviour.contacts import TCP
from apps.kitsune.behaviour.findings import HALF_LIFE_S, MOST_NATS, Finding, FoundSoFar
from apps.kitsune.behaviour.rows import SenderId
from apps.kitsune.kernel import Columns, Kernel, load_kernel
from apps.kitsune.kernel_rows import MarkedRoom, MarkedSyns, rows_of

NUMBERS: Final = 1 << 32
"""Sequence numbers that a stack chooses from."""
MOST_AT_A_TIME: Final = 256
"""Such SYNs of a batch that are looked at: a few decide."""
_NAMES: Final = ("port", "eth_src", "ip_src_lo", "ip_dst_lo", "tcp_dport", "arrival")


class SynFingerprints:
    """Finds scanners by the sequence numbers of their SYNs; IPv4 only, as they are.

    Args:
        kernel: None loads the one that was built.
    """

    def __init__(self, kernel: Kernel | None = None) -> None:
        self._kernel = kernel or load_kernel()
        self._room = MarkedRoom(self._kernel, MOST_AT_A_TIME)
        self.syns = 0
        """Of training."""
        self.marked = 0
        """Those of them that had their destination's address."""
        self._times: OrderedDict[SenderId, list[float]] = OrderedDict()
        """Capture times of such SYNs, seconds: the last ones of each sender, who was heard last at the end."""
        self._settled: dict[SenderId, float] = {}
        """Until when nothing about a sender can be worth a message, seconds: everything was said a moment ago."""
        self._found = FoundSoFar()

    def __len__(self) -> int:
        """Senders of such SYNs that are remembered."""
        return len(self._times)

    def add(self, batch: Columns, switch: str, trained: int, senders: int) -> list[Finding]:
        """Takes a batch of which the first `trained` packets were training.

        Args:
            batch: packet columns; without `tcp_seq` nothing is found.
            switch: where they were seen.
            trained: packets at the beginning that belong to training.
            senders: how many training has seen.

        Returns:
            What is worth a message.
        """
        if "tcp_seq" not in batch:
            return []
        syns = rows_of(self._kernel, batch).marked(trained, self._room)
        self.syns += syns.opening
        self.marked += syns.learnt
        if not syns.senders or self._are_settled(switch, syns):
            return []
        return self._findings(batch, syns.rows, switch, self._nats(senders))

    def _are_settled(self, switch: str, syns: MarkedSyns) -> bool:
        """Whether nothing can be worth a message, as in most batches of a scan; then the SYNs are counted."""
        heard = []
        for port, mac, address, times, newest in syns.senders:
            sender: SenderId = (switch, port, mac, address)
            if not newest < self._settled.get(sender, 0.0):
                return False
            heard.append((self._times[sender], times))
        for former, own in heard:
            _extend(former, own)
        return True

    def _nats(self, senders: int) -> float:
        expected = self.marked + max(1, self.syns) / NUMBERS
        return max(0.0, math.log(max(1, senders) / expected))

    def _findings(self, batch: Columns, rows: Any, switch: str, nats: float) -> list[Finding]:
        found: list[Finding] = []
        columns = (batch[name][rows].tolist() for name in _NAMES)
        times = (batch["time_us"][rows] / 1e6).tolist()
        settled = self._settled
        for time, port, mac, source, target, dport, arrival in zip(times, *columns, strict=True):
            sender: SenderId = (switch, port, mac, source)
            if time < settled.get(sender, 0.0):
                _append(self._times[sender], time)
                continue
            count, begun = self._counted(sender, time)
            total = min(nats * count, MOST_NATS)
            added = self._found.added(sender, total, time)
            if total == MOST_NATS:
                settled[sender] = self._found.until(sender, MOST_NATS)
            if added:
                seen = (added, total, float(count), HALF_LIFE_S, float(self.marked), begun)
                found.append(Finding("fingerprint", sender, target, TCP | dport, *seen, time, arrival))
        return found

    def _counted(self, sender: SenderId, time: float) -> tuple[int, float]:
        """Adds a SYN: how many there were in the last ten minutes, and the time of the first."""
        self._forget_silent(time)
        times = self._times.setdefault(sender, [])
        self._times.move_to_end(sender)
        _append(times, time)
        first = bisect_left(times, times[-1] - HALF_LIFE_S)
        return len(times) - first, times[first]

    def _forget_silent(self, time: float) -> None:
        """Who was silent for ten minutes, a few at a time, and who is one too many."""
        for _ in range(FORGOTTEN_AT_A_TIME):
            oldest = next(iter(self._times), None)
            if oldest is None:
                return
            times = self._times[oldest]
            if times[-1] >= time - HALF_LIFE_S and len(self._times) < MOST_SUBJECTS:
                return
            del self._times[oldest]
            self._settled.pop(oldest, None)

    def to_state(self) -> list[int]:
        """Plain values for the model file."""
        return [self.syns, self.marked]

    def restore(self, state: Iterable[Any]) -> None:
        """The inverse of `to_state`.

        Raises:
            TypeError, ValueError: the state is not one.
        """
        syns, marked = map(int, state)
        if not 0 <= marked <= syns:
            raise ValueError(f"{marked} of {syns} SYNs had their destination's address")
        self.syns, self.marked = syns, marked


def _append(times: list[float], time: float) -> None:
    times.append(
        time if not times or time > times[-1] else times[-1]
    )  # two ports may deliver in another order
    if len(times) > MOST_EVENTS:
        del times[: MOST_EVENTS // 4]


def _extend(times: list[float], more: list[float]) -> None:
    """As `_append` of each, where there are times; `more` never goes back."""
    last = times[-1]
    times += more if more[0] >= last else [max(time, last) for time in more]
    over = len(times) - MOST_EVENTS
    if over > 0:
        quarter = MOST_EVENTS // 4
        del times[: -(-over // quarter) * quarter]
