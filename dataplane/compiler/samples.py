"""A digest's sample as it travels: one element of the field `data` of a P4Runtime DigestList.

    0x1a <len> 0x2a <len> ┌ 0x0a <len> 0x0a <len> value          (for each member, big endian, shortest)
    data       struct     └ members    bitstring

The back end writes samples so at once: of a list of hundreds with thirty members each, nothing but the
joining is left to do (runtime_types.h has the same in C).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Samples of one digest end to end: objects of who looks at them only."""

    data: bytes | memoryview
    ends: NDArray[np.int64]
    """Where each ends."""
    hashes: NDArray[np.uint64]
    """Of equal samples equal."""

    def __len__(self) -> int:
        return len(self.ends)

    def each(self) -> list[bytes]:
        """One by one."""
        data, ends = bytes(self.data), self.ends.tolist()
        return [data[begin:end] for begin, end in zip([0, *ends], ends, strict=False)]

    def part(self, first: int, end: int) -> "Samples":
        """Those from one number up to another."""
        if first == 0 and end == len(self):
            return self
        begin = int(self.ends[first - 1]) if first else 0
        ends = self.ends[first:end] - begin
        stop = begin + int(ends[-1]) if len(ends) else begin
        return Samples(memoryview(self.data)[begin:stop], ends, self.hashes[first:end])


def varint(value: int) -> bytes:
    """A protobuf varint."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def decode(sample: bytes) -> tuple[int, ...]:
    """The members of a sample that the back end made."""
    at = _behind_varint(sample, 1)
    at = _behind_varint(sample, at + 1)
    values = []
    while at < len(sample):
        first, size = at + 4, sample[at + 3]
        values.append(int.from_bytes(sample[first : first + size], "big"))
        at = first + size
    return tuple(values)


def _behind_varint(data: bytes, at: int) -> int:
    while data[at] & 0x80:
        at += 1
    return at + 1
