"""Samples of digests, member by member."""

from collections.abc import Iterable

from dataplane.compiler.samples import varint

_PREFIXES = [bytes((0x0A, 2 + size, 0x0A, size)) for size in range(65)]
_SMALL = [_PREFIXES[1] + bytes([value]) for value in range(256)]


def encode_sample(values: Iterable[int]) -> bytes:
    """A sample of these members, each below 2^512."""
    members = b"".join([_SMALL[v] if v < 256 else _member(v) for v in values])
    struct = b"".join((b"\x2a", varint(len(members)), members))
    return b"".join((b"\x1a", varint(len(struct)), struct))


def _member(value: int) -> bytes:
    size = (value.bit_length() + 7) // 8
    return _PREFIXES[size] + value.to_bytes(size, "big")
