"""Packet-in messages of a switch → columns, in the order of the stream, with losses counted.

The switch numbers its packet-ins from 1, so a gap is a loss between switch and here.  Its clock
counts microseconds since a base that the controller knows: absolute times are integers made before
any float (`base_us + timestamp`).

A packet-in whose `reason` is not 0 is not a copied frame but the answer to a request about a counting
cell (`packet_out`); it has no sequence number.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.p4runtime_ctrl.southbound.capture_times import CaptureTimes
from apps.p4runtime_ctrl.southbound.loss_tracker import LossTracker
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.packet_out import question_of
from apps.p4runtime_ctrl.southbound.rows import RowLayout, has_bit, in_time
from due import RecordBatch

ReadFrames = Callable[..., RecordBatch]
"""`apps.packets.read_frames(frames, lengths=, times_us=, ports=, sequence=, arrival=)`."""

_HEADER: Final = "packet_in"
_CELL: Final = 1
_LARGEST: Final = 65_535
"""Most bytes of a frame."""
_NEEDED: Final = ("ingress_port", "reason", "timestamp", "length", "sequence", "arrival", "query_map")


@dataclass(frozen=True)
class PacketInBatch:
    """Frames of one batch, as received from the switch."""

    frames: list[bytes]
    port: NDArray[np.uint16]
    time_us: NDArray[np.int64]
    length: NDArray[np.uint32]
    sequence: NDArray[np.uint64]
    arrival: NDArray[np.uint64]
    queries: NDArray[np.uint8]
    """Which queries each frame matched: 256 bits a row, big-endian."""

    cells: RecordBatch | None = None
    """Answers about counting cells in the batch: `id` of the request, `count`, `epoch` (number of the window) and
    `overflow` (1: the cell holds another key)."""

    def __len__(self) -> int:
        return len(self.frames)

    def matching(self, bit: int) -> "PacketInBatch":
        """The packets that carry a query's bit; `self` if all do."""
        wanted = has_bit(self.queries, bit)
        return self if wanted.all() else self.rows(np.flatnonzero(wanted))

    def rows(self, index: NDArray[np.intp]) -> "PacketInBatch":
        """Some of the packets, in the order of `index`."""
        return PacketInBatch(
            frames=[self.frames[row] for row in index],
            port=self.port[index],
            time_us=self.time_us[index],
            length=self.length[index],
            sequence=self.sequence[index],
            arrival=self.arrival[index],
            queries=self.queries[index],
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

    def raw(self) -> dict[str, Any]:
        """The frames themselves, with the numbers that `apps.packets.read_frames` takes."""
        return {
            "frames": self.frames,
            "lengths": self.length,
            "times_us": self.time_us,
            "ports": self.port,
            "sequence": self.sequence,
            "arrival": self.arrival,
        }


class PacketReader:
    """Reads the packet-in header of one switch and records sequence numbers in `progress`.

    `base_us` is the absolute time of the switch's clock zero, integer microseconds since the epoch; `times` replaces
    the switch's clock by the times of a capture.
    Raises `ProgramError` where the program's packet-in header lacks a field.
    """

    def __init__(
        self, program: ProgramInfo, base_us: int, progress: LossTracker, times: CaptureTimes | None = None
    ) -> None:
        program.header(_HEADER, _NEEDED)
        fields = program.headers[_HEADER]
        self._layout = RowLayout((field.name, field.width) for field in fields)
        self._ids = [field.id for field in fields]
        self._base_us = base_us
        self._times = times
        self._progress = progress

    def read(self, messages: Sequence[Any]) -> PacketInBatch:
        """Columns of the header fields; counts gaps of the sequence, and messages that are malformed."""
        header, rows = self._layout.read([self._values(message.metadata) for message in messages])
        frames = [messages[row].payload for row in rows.tolist()]
        sound = in_time(header) & np.fromiter((len(f) <= _LARGEST for f in frames), np.bool_, len(frames))
        if not sound.all():
            header, frames = header[sound], [frames[row] for row in np.flatnonzero(sound)]
        self._progress.malformed += len(messages) - len(frames)
        copies = header["reason"] == 0
        cells = None
        if not copies.all():
            cells = _cells(header[~copies], [frames[row] for row in np.flatnonzero(~copies)])
            frames = [frames[row] for row in np.flatnonzero(copies)]
            header = header[copies]
        packets = PacketInBatch(
            frames=frames,
            port=header["ingress_port"].astype(np.uint16),
            time_us=self._time_us(header),
            length=header["length"].astype(np.uint32),
            sequence=header["sequence"].astype(np.uint64),
            arrival=header["arrival"].astype(np.uint64),
            queries=header["query_map"],
            cells=cells,
        )
        self._progress.packets(packets.sequence, packets.arrival, packets.time_us)
        return packets

    def _time_us(self, header: NDArray[Any]) -> NDArray[np.int64]:
        if self._times is not None:
            return self._times.of(header["arrival"])
        times_us: NDArray[np.int64] = header["timestamp"].astype(np.int64) + self._base_us
        return times_us

    def _values(self, metadata: Any) -> list[bytes]:
        """Header values in the program's order; messages may carry them in any order."""
        if [item.metadata_id for item in metadata] == self._ids:
            return [item.value for item in metadata]
        found = {item.metadata_id: item.value for item in metadata}
        return [found[each] for each in self._ids if each in found]  # too few: malformed


def _cells(header: NDArray[Any], payloads: list[bytes]) -> RecordBatch:
    numbers = [question_of(payload) for payload in payloads]
    known = np.array([number is not None for number in numbers], dtype=np.bool_) & (header["reason"] == _CELL)
    header = header[known]
    return RecordBatch(
        {
            "id": np.array([number for number, keep in zip(numbers, known, strict=True) if keep], np.uint64),
            "count": header["sequence"].astype(np.uint32),
            "epoch": header["arrival"].astype(np.uint32),
            "overflow": header["query_map"].any(axis=1).astype(np.uint8),
        }
    )
