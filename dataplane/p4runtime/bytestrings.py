"""P4Runtime's byte strings: unsigned numbers, big endian, as short as possible (specification 8.4)."""

from dataplane.p4runtime.status import OutOfRange


def encode(value: int) -> bytes:
    """The canonical string of a number: no leading zero byte, and one zero byte for 0."""
    return value.to_bytes((value.bit_length() + 7) // 8 or 1, "big")


def decode(data: bytes, width: int, what: str) -> int:
    """The number in a byte string; leading zeros are allowed.

    width: bits of the field
    what: the field's name for the error text

    Raises OutOfRange for an empty string or a value of more than `width` bits.
    """
    value = int.from_bytes(data, "big")
    if not data:
        raise OutOfRange(f"{what}: empty byte string; send one zero byte for 0")
    if value >> width:
        raise OutOfRange(f"{what}: {value:#x} does not fit into {width} bits")
    return value
