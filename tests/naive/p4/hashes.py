"""The hashes of v1model, by p4c's names."""

import binascii
import zlib
from collections.abc import Callable


def crc16(data: bytes) -> int:
    """CRC-16/ARC: polynomial 0x8005 reflected, no initial value."""
    crc = 0
    for octet in data:
        crc = (crc >> 8) ^ _CRC16[(crc ^ octet) & 0xFF]
    return crc


def _crc16_entry(value: int) -> int:
    for _ in range(8):
        value = (value >> 1) ^ (0xA001 if value & 1 else 0)
    return value


_CRC16 = tuple(_crc16_entry(i) for i in range(256))


def crc_ccitt(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xffff."""
    return binascii.crc_hqx(data, 0xFFFF)


def csum16(data: bytes) -> int:
    """Internet checksum (RFC 1071) of the data, padded with a zero byte to even length."""
    total = int.from_bytes(data + b"\0" * (len(data) % 2), "big")
    if not total:
        return 0xFFFF
    return 0xFFFF - ((total - 1) % 0xFFFF + 1)


def identity(data: bytes) -> int:
    """The first eight bytes as a number."""
    return int.from_bytes(data[:8], "big")


def _xor(data: bytes, size: int) -> int:
    padded = data + b"\0" * (-len(data) % size)
    result = 0
    for start in range(0, len(padded), size):
        result ^= int.from_bytes(padded[start : start + size], "big")
    return result


HASHES: dict[str, Callable[[bytes], int]] = {
    "crc32": zlib.crc32,
    "crc32_custom": zlib.crc32,
    "crc16": crc16,
    "crc16_custom": crc16,
    "crcCCITT": crc_ccitt,
    "csum16": csum16,
    "cksum16": csum16,
    "identity": identity,
    "xor16": lambda data: _xor(data, 2),
    "xor32": lambda data: _xor(data, 4),
}
"""By p4c's names; the custom CRCs have BMv2's default parameters."""
