"""Requests of apps to send frames or to read cells → packet-out messages.

    network.packet_out.<app>.<switch>     frames to be sent out of a port
    network.cell_request.<app>.<switch>   questions about counting cells, and to report those that wait for
                                          a window's end; the answers come as packet-ins

A request carries its number as the payload of its packet-out and the answer returns it, so no state has to
be kept between the two.
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.p4runtime_ctrl.arrivals import FramesToSend
from apps.p4runtime_ctrl.errors import EntryError
from apps.p4runtime_ctrl.southbound.counts_in import DIGEST
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.values import canonical
from due import RecordBatch
from p4rt import p4runtime

_HEADER: Final = "packet_out"
_NEEDED: Final = (
    "egress_port", "operation", "query", "key_source", "key_destination", "key_port", "key_length", "timestamp",
)  # fmt: skip
_SEND, _READ_CELL, _SWEEP = 0, 1, 2
_SWEEPS: Final = (0, 1, 2)
_NO_SWEEP, _, _SWEEP_ANSWERED = _SWEEPS
"""Values of the column `sweep`."""
_ID_BYTES: Final = 8
_CLOCK_BITS: Final = 48


class PacketOuts:
    """Makes the packet-outs of one program.  Raises `ProgramError` where its header lacks a field."""

    def __init__(self, program: ProgramInfo, base_us: int) -> None:
        program.header(_HEADER, _NEEDED)
        self._fields = program.headers[_HEADER]
        self._largest_port = (1 << self._width("egress_port")) - 1
        self._has_source_port = any(field.name == "key_source_port" for field in self._fields)
        self._can_sweep = (
            program.digest_id(DIGEST) != 0
        )  # a program without it would send the request out of a port
        self._base_us = base_us

    def frames(self, frames: FramesToSend) -> list[Any]:
        """Packet-outs of some frames; raises `EntryError` for a port that the program cannot express."""
        ports, lengths, data = frames.ports, frames.lengths, frames.data
        wrong = [port for port in ports if not 0 <= port <= self._largest_port]
        if wrong:
            raise EntryError(f"packet_out: there is no port {wrong[0]}; the highest is {self._largest_port}")
        ends = np.cumsum(lengths).tolist()
        return [
            self._message({"egress_port": port, "operation": _SEND}, data[end - length : end])
            for port, length, end in zip(ports, lengths, ends, strict=True)
        ]

    def questions(self, columns: RecordBatch) -> tuple[list[Any], int]:
        """One packet-out for each row of a request for cells, and the number of rows that cannot be sent.

        Columns: `id`, `query` (bit), `src_hi`, `src_lo`, `dst_hi`, `dst_lo`, `port`, `length`, `time_us`
        (absolute, within the window that is meant), and `source_port` where the program counts by it.
        `sweep`: 0 or no such column = read the cell; else report one key of `query` that waits for the end
        of a window, as of `time_us` (0: as of now): 1 = answered only where more wait, 2 = answered always.
        The answer's `count` is then 1 where more wait, else 0.
        """
        sweeps, time_us = columns["sweep"], columns["time_us"].astype(np.int64)
        now = (sweeps != _NO_SWEEP) & (time_us == 0)
        clock = np.where(now, 0, time_us - self._base_us)
        askable = (clock >= 0) & (clock < 1 << _CLOCK_BITS) & np.isin(sweeps, _SWEEPS)
        clock[(sweeps != _NO_SWEEP) & ~now & (clock == 0)] = 1  # 0 would mean now
        if not self._has_source_port:
            askable &= columns["source_port"] == 0
        if not self._can_sweep:
            askable &= sweeps == _NO_SWEEP
        rows = np.flatnonzero(askable).tolist()
        return [self._question(columns, row, int(clock[row])) for row in rows], len(askable) - len(rows)

    def _question(self, columns: Mapping[str, NDArray[Any]], row: int, clock: int) -> Any:
        def number(name: str) -> int:
            return int(columns[name][row])

        sweep = number("sweep")
        header = {
            "operation": _SWEEP if sweep else _READ_CELL,
            "query": number("query"),
            "key_source": number("src_hi") << 64 | number("src_lo"),
            "key_destination": number("dst_hi") << 64 | number("dst_lo"),
            "key_port": number("port"),
            "key_length": int(sweep == _SWEEP_ANSWERED) if sweep else number("length"),
            "key_source_port": number("source_port"),
            "timestamp": clock,
        }
        return self._message(header, number("id").to_bytes(_ID_BYTES, "big"))

    def _message(self, header: Mapping[str, int], payload: bytes) -> Any:
        packet = p4runtime.PacketOut(payload=payload)
        for field in self._fields:
            packet.metadata.add(metadata_id=field.id, value=canonical(header.get(field.name, 0)))
        return packet

    def _width(self, name: str) -> int:
        return next(field.width for field in self._fields if field.name == name)


def question_of(payload: bytes) -> int | None:
    """The number of the request that an answer belongs to; None for other payloads."""
    return int.from_bytes(payload[:_ID_BYTES], "big") if len(payload) >= _ID_BYTES else None
