"""Completed TCP handshakes: the clients that are known to a service.

A handshake counts when the client's ACK acknowledges the server's sequence number + 1: a spoofer, who
never sees the SYN-ACK, cannot enter the history.  If only one direction passes the
switch, no handshake is detected.
"""

from collections import OrderedDict
from typing import Final

import numpy as np

from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.host.evaluation import evaluate
from apps.sonata_adapter.query.expressions import ACK, SYN_ACK, address_text
from apps.sonata_adapter.query.language import tcp
from apps.sonata_adapter.results import Handshake
from due import RecordBatch

DEFAULT_OPEN: Final = 65_536
_AGE_US: Final = 30_000_000
_MASK: Final = 0xFFFF_FFFF

_Connection = tuple[int, int, int, int, int, int]
"""Client (high, low), server (high, low), client's port, server's port."""


class Handshakes:
    """Follows handshakes over batches in the order of capture time; memory bounded.

    A half-open handshake is forgotten when it is too old to be completed.  `limit` is how many are remembered at a
    time; beyond it the oldest is forgotten and counted in `forgotten`.
    """

    def __init__(self, *, limit: int = DEFAULT_OPEN) -> None:
        self._limit = limit
        self._open: OrderedDict[_Connection, tuple[int, int]] = OrderedDict()
        """By connection: the server's sequence number, and when it answered; the last answer is the last."""
        self.completed = 0
        self.forgotten = 0
        self.wrong = 0
        """ACKs towards half-open connections that do not acknowledge the server's number."""

    def __len__(self) -> int:
        """How many handshakes are half-open."""
        return len(self._open)

    def process(self, batch: RecordBatch) -> list[Handshake]:
        """Handshakes that the batch completes, in order."""
        packets = PacketColumns(batch)
        answers = evaluate((tcp.flags == SYN_ACK).node, packets)
        rows = np.flatnonzero(answers | evaluate((tcp.flags == ACK).node, packets))
        if not len(rows):
            return []
        columns = zip(
            *(batch[name][rows].tolist() for name in ("ip_src_hi", "ip_src_lo", "ip_dst_hi", "ip_dst_lo")),
            *(batch[name][rows].tolist() for name in ("tcp_sport", "tcp_dport", "tcp_seq", "tcp_ack")),
            batch["ip_version"][rows].tolist(),
            batch["time_us"][rows].tolist(),
            answers[rows].tolist(),
            strict=True,
        )
        found = []
        for src_hi, src_lo, dst_hi, dst_lo, sport, dport, seq, ack, version, at, answer in columns:
            if answer:
                self._answered((dst_hi, dst_lo, src_hi, src_lo, dport, sport), seq, at)
                continue
            connection = (src_hi, src_lo, dst_hi, dst_lo, sport, dport)
            if self._acknowledged(connection, ack, at):
                source = address_text(version, src_hi << 64 | src_lo)
                service = address_text(version, dst_hi << 64 | dst_lo)
                found.append(Handshake(source=source, service=service, port=dport, at_us=at))
        return found

    def _answered(self, connection: _Connection, sequence: int, at: int) -> None:
        self._open[connection] = (sequence, at)
        self._open.move_to_end(connection)
        while len(self._open) > self._limit:
            self._open.popitem(last=False)
            self.forgotten += 1
        while next(iter(self._open.values()))[1] < at - _AGE_US:
            self._open.popitem(last=False)

    def _acknowledged(self, connection: _Connection, acknowledged: int, at: int) -> bool:
        half = self._open.get(connection)
        if half is None:
            return False
        sequence, since = half
        if (sequence + 1) & _MASK != acknowledged:
            self.wrong += 1
            return False
        del self._open[connection]
        if at - since > _AGE_US:
            return False
        self.completed += 1
        return True
