"""What a back end offers the switch: the loaded program with its state, without names or checks.

`c_machine.CMachine` makes it.  Callers hold the switch's lock and have checked every number; tables are addressed by slots that `tables.Table` hands out.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from dataplane.compiler import samples
from dataplane.compiler.samples import Samples
from dataplane.v1model.tree import Program

Replicas = tuple[tuple[int, int], ...]
"""(port, instance) of each copy."""


class Digest(NamedTuple):
    """One digest message: its name in the program, and its fields as samples.py has them."""

    name: str
    sample: bytes

    @property
    def values(self) -> tuple[int, ...]:
        """The fields in order."""
        return samples.decode(self.sample)


@dataclass(frozen=True, slots=True, eq=False)
class FrameSlices:
    """(port, frame) pairs that stand in one piece of memory: objects of who looks at them only."""

    ports: NDArray[np.int64]
    begins: NDArray[np.int64]
    ends: NDArray[np.int64]
    data: bytes

    def __len__(self) -> int:
        return len(self.ports)

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        return zip(self.ports.tolist(), self.frames(), strict=True)

    def frames(self) -> list[bytes]:
        """The frames alone."""
        pairs = zip(self.begins.tolist(), self.ends.tolist(), strict=True)
        return [self.data[begin:end] for begin, end in pairs]

    def to(self, port: int) -> "FrameSlices":
        """Those of one port."""
        return self.of(self.ports == port)

    def of(self, rows: NDArray[np.bool_]) -> "FrameSlices":
        """Those of the rows that are true."""
        return FrameSlices(self.ports[rows], self.begins[rows], self.ends[rows], self.data)


@dataclass(slots=True)
class BatchResult:
    """What one frame, or one batch of frames, led to."""

    outputs: list[tuple[int, bytes]] | FrameSlices = field(default_factory=list)
    """(port, frame) in the order of sending; frames to the CPU port are in `packet_ins` instead."""
    packet_ins: list[bytes] = field(default_factory=list)
    """Payloads as sent to the CPU port: the packet_in header in front, then the frame."""
    digests: list[Digest] = field(default_factory=list)
    samples: Mapping[str, Samples] = field(default_factory=dict)
    """In place of `digests`, of a block of frames: by name, in order."""
    verdicts: bytes = b""
    """One byte per frame: bit 0 it made a packet-in, bit 1 it left through a port."""


@dataclass(frozen=True, slots=True)
class KeyPlace:
    """Where a table's key fields stand in one long integer: shift in bits, by field."""

    shifts: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class RangePart:
    """One bounded field of an entry: position in the key, width in bits, bounds."""

    shift: int
    width: int
    low: int
    high: int


Rule = tuple[int, int, tuple[RangePart, ...], int]
"""What an entry matches, as the back ends look it up: value, mask, ranges, rank.

The largest rank wins, then the lowest slot.
"""


class TableStore(Protocol):
    """Entries of one table, by slot."""

    place: KeyPlace

    def insert(self, slot: int, rule: Rule, action: int, params: Sequence[int], now_us: int) -> None: ...

    def replace(self, slot: int, action: int, params: Sequence[int]) -> None: ...

    def remove(self, slot: int) -> None: ...

    def set_default(self, action: int, params: Sequence[int]) -> None:
        """Action -1: none."""

    def counter(self, slot: int) -> tuple[int, int]:
        """(packets, bytes)"""
        ...

    def set_counter(self, slot: int, packets: int, octets: int) -> None: ...

    def set_meter(self, slot: int, rates: tuple[int, int, int, int] | None) -> None:
        """(cir, cburst, pir, pburst); None = always green."""

    def hit_us(self, slot: int) -> int:
        """Packet time of the last hit, or of the insertion."""
        ...

    def touch(self, slot: int, now_us: int) -> None: ...


class CounterStore(Protocol):
    def read(self, index: int) -> tuple[int, int]: ...

    def write(self, index: int, packets: int, octets: int) -> None: ...


class MeterStore(Protocol):
    def configure(self, index: int, rates: tuple[int, int, int, int] | None) -> None: ...


class RegisterStore(Protocol):
    def read(self, index: int) -> int: ...

    def write(self, index: int, value: int) -> None: ...

    def written(self) -> list[tuple[int, int]]:
        """(index, value) of the cells that are not 0."""
        ...


class Machine(Protocol):
    """A program with its state, ready to run."""

    text: str
    """What was generated."""

    @property
    def tables(self) -> Mapping[str, TableStore]: ...

    @property
    def counters(self) -> Mapping[str, CounterStore]: ...

    @property
    def meters(self) -> Mapping[str, MeterStore]: ...

    @property
    def registers(self) -> Mapping[str, RegisterStore]: ...

    def run(self, port: int, frames: Sequence[bytes], times_us: Sequence[int]) -> BatchResult: ...

    def run_block(
        self, port: int, data: bytes, lengths: NDArray[np.uint32], times_us: NDArray[np.int64]
    ) -> BatchResult:
        """As `run`, with the frames end to end."""
        ...

    def set_clone_session(self, session: int, replicas: Replicas | None, packet_length: int) -> None:
        """None removes it."""

    def set_multicast_group(self, group: int, replicas: Replicas | None) -> None: ...

    def set_ports(self, ports: frozenset[int] | None) -> None:
        """Frames to other ports are dropped; None = every port exists."""

    def statistics(self) -> dict[str, int]: ...

    def out_of_range(self) -> dict[str, int]:
        """Accesses beyond an array's last cell, by the array's name; arrays without any are left out."""
        ...

    def close(self) -> None: ...


MachineMaker = Callable[[Program, int], Machine]
"""Makes a machine for a program and the number of the port to the controller."""


def array_names(program: Program) -> tuple[str, ...]:
    """Counters, meters and registers in the order in which the back ends number them together."""
    return (*program.counters, *program.meters, *program.registers)


STATISTICS = ("frames", "parser_errors", "dropped", "no_such_port", "loop_drops", "oversized")
