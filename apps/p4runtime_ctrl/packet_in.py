"""Packet-in messages of a switch → columns, in the order of the stream, with losses counted.

The switch numbers its packet-ins from 1, so a gap is a loss between switch and here.  Its clock
counts microseconds since a base that the controller knows: absolute times are integers made before
any float (`base_us + timestamp`).

A packet-in whose `reason` is not 0 is no copied frame but an answer to a packet-out; it has no number
in the sequence.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.p4runtime_ctrl.p4info import Program
from due import RecordBatch

ReadFrames = Callable[..., RecordBatch]
"""`apps.packets.read_frames(frames, lengths, times_us, ports, sequence, arrival)`."""

_HEADER: Final = "packet_in"
_NUMBERS: Final = ("ingress_port", "timestamp", "length", "sequence", "arrival")
_REASON: Final = "reason"
_MAP: Final = "query_map"
_WRAP: Final = 1 << 32


@dataclass(frozen=True)
class Packets:
    """Frames of one batch, as the switch handed them over."""

    frames: list[bytes]
    port: NDArray[np.uint16]
    time_us: NDArray[np.int64]
    length: NDArray[np.uint32]
    sequence: NDArray[np.uint64]
    arrival: NDArray[np.uint64]
    query_maps: list[bytes]
    """Big-endian, canonical; which queries each frame matched."""

    def __len__(self) -> int:
        return len(self.frames)

    def matching(self, bit: int) -> "Packets":
        """The packets that carry a query's bit: themselves where all do."""
        memo: dict[bytes, bool] = {}
        wanted = [
            memo[data]
            if data in memo
            else memo.setdefault(data, bool(int.from_bytes(data, "big") >> bit & 1))
            for data in self.query_maps
        ]
        if all(wanted):
            return self
        return self.rows(np.flatnonzero(np.array(wanted, dtype=bool)))

    def rows(self, index: NDArray[np.intp]) -> "Packets":
        """Some of the packets, in the order of `index`."""
        return Packets(
            frames=[self.frames[row] for row in index],
            port=self.port[index],
            time_us=self.time_us[index],
            length=self.length[index],
            sequence=self.sequence[index],
            arrival=self.arrival[index],
            query_maps=[self.query_maps[row] for row in index],
        )

    def batch(self, read_frames: ReadFrames) -> RecordBatch:
        """The packet records (`apps.packets.PACKET_COLUMNS`)."""
        return read_frames(
            self.frames,
            lengths=self.length,
            times_us=self.time_us,
            ports=self.port,
            sequence=self.sequence,
            arrival=self.arrival,
        )


class PacketReader:
    """Reads the packet-in header of one switch and keeps its count.

    `base_us` is the absolute time of the switch's clock zero, integer microseconds since the epoch.
    Raises `ProgramError` where the program's packet-in header lacks a field.
    """

    def __init__(self, program: Program, base_us: int) -> None:
        fields = program.header(_HEADER, (*_NUMBERS, _REASON, _MAP))
        self._ids = tuple(fields[name].id for name in _NUMBERS)
        self._map_id = fields[_MAP].id
        self._order = tuple(field.id for field in program.headers[_HEADER])
        self._picks = tuple(self._order.index(wanted) for wanted in self._ids)
        self._map_pick = self._order.index(self._map_id)
        self._reason_pick = self._order.index(fields[_REASON].id)
        self._base_us = base_us
        self._last: int | None = None
        self.received = 0
        self.lost = 0
        self.restarts = 0
        self.arrival = 0
        self.time_us = 0

    def expect_first(self) -> None:
        """The switch was given its program just now: the next packet-in is number 1."""
        self._last = 0

    def read(self, messages: Sequence[Any]) -> Packets:
        """Columns of the header fields; counts gaps of the sequence in `lost`."""
        rows = [self._values(message.metadata) for message in messages]
        if any(row[self._reason_pick].strip(b"\0") for row in rows):
            copied = [not row[self._reason_pick].strip(b"\0") for row in rows]
            rows = list(compress(rows, copied))
            messages = list(compress(messages, copied))
        picks = self._picks
        from_bytes = int.from_bytes
        numbers = np.array(
            [[from_bytes(row[pick], "big") for pick in picks] for row in rows], dtype=np.int64
        ).reshape(len(rows), len(picks))
        packets = Packets(
            frames=[message.payload for message in messages],
            port=numbers[:, 0].astype(np.uint16),
            time_us=numbers[:, 1] + self._base_us,
            length=numbers[:, 2].astype(np.uint32),
            sequence=numbers[:, 3].astype(np.uint64),
            arrival=numbers[:, 4].astype(np.uint64),
            query_maps=[row[self._map_pick] for row in rows],
        )
        if rows:
            self._count(numbers[:, 3])
            self.arrival = int(numbers[-1, 4])
            self.time_us = int(packets.time_us[-1])
        return packets

    def _values(self, metadata: Any) -> list[bytes]:
        """Header values in the program's order; messages may carry them in any order."""
        ids = self._order
        values = [b""] * len(ids)
        for place, item in enumerate(metadata):
            if place < len(ids) and item.metadata_id == ids[place]:
                values[place] = item.value
            elif item.metadata_id in ids:
                values[ids.index(item.metadata_id)] = item.value
        return values

    def _count(self, sequence: NDArray[np.int64]) -> None:
        before = int(sequence[0]) - 1 if self._last is None else self._last
        steps = np.diff(sequence, prepend=before) % _WRAP
        backwards = steps >= _WRAP // 2
        gaps = steps[~backwards & (steps > 1)]
        self.lost += int(gaps.sum()) - len(gaps)
        # a switch that began anew counts from 1 again: what it sent before this one is lost, too
        self.lost += int((sequence[backwards] - 1).sum())
        self.restarts += int(backwards.sum())
        self.received += len(sequence)
        self._last = int(sequence[-1])
