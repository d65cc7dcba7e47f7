"""Stateful and computing externs: counters, meters, registers, hashes.

The arrays here are the control plane's view; the state itself is the back end's (compiler/machine.py).
"""

import binascii
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from threading import RLock
from typing import Protocol

from dataplane.errors import DataplaneError, InvalidIndex
from dataplane.v1model.tree import ArraySpec

# -- values -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CounterValue:
    packets: int = 0
    bytes: int = 0


@dataclass(frozen=True, slots=True)
class MeterConfig:
    """Two-rate three-colour marker: rates per second, bursts; packets or bytes as the program says."""

    cir: int
    cburst: int
    pir: int
    pburst: int

    def check(self) -> None:
        """Raises DataplaneError where a number is negative or the committed rate exceeds the peak rate."""
        if min(self.cir, self.cburst, self.pir, self.pburst) < 0:
            raise DataplaneError(f"meter configuration {self} has a negative number")
        if self.cir > self.pir:
            raise DataplaneError(f"meter configuration {self}: cir must not exceed pir")

    @property
    def rates(self) -> tuple[int, int, int, int]:
        return (self.cir, self.cburst, self.pir, self.pburst)


# -- arrays -----------------------------------------------------------------------------------------


class _Counters(Protocol):
    def read(self, index: int) -> tuple[int, int]: ...

    def write(self, index: int, packets: int, octets: int) -> None: ...


class _Meters(Protocol):
    def configure(self, index: int, rates: tuple[int, int, int, int] | None) -> None: ...


class _Registers(Protocol):
    def read(self, index: int) -> int: ...

    def write(self, index: int, value: int) -> None: ...

    def written(self) -> list[tuple[int, int]]: ...


class _Array:
    """An array of `size` cells, named as in the program."""

    def __init__(self, spec: ArraySpec, lock: RLock) -> None:
        self.name = spec.name
        self.size = spec.size
        self.spec = spec
        self._lock = lock

    def _check(self, index: int) -> None:
        if not 0 <= index < self.size:
            raise InvalidIndex(f"{self.name} has no index {index}: it has {self.size} cells, counted from 0")


class CounterArray(_Array):
    """An indirect counter array."""

    def __init__(self, spec: ArraySpec, store: _Counters, lock: RLock) -> None:
        super().__init__(spec, lock)
        self._store = store

    def read(self, index: int) -> CounterValue:
        """Raises InvalidIndex."""
        self._check(index)
        with self._lock:
            return CounterValue(*self._store.read(index))

    def write(self, index: int, value: CounterValue) -> None:
        """Raises InvalidIndex."""
        self._check(index)
        with self._lock:
            self._store.write(index, value.packets, value.bytes)


class MeterArray(_Array):
    """An indirect meter array."""

    def __init__(self, spec: ArraySpec, store: _Meters, lock: RLock) -> None:
        super().__init__(spec, lock)
        self._store = store
        self._configs: dict[int, MeterConfig] = {}

    def config(self, index: int) -> MeterConfig | None:
        """None = unconfigured (always green).  Raises InvalidIndex."""
        self._check(index)
        with self._lock:
            return self._configs.get(index)

    def configure(self, index: int, config: MeterConfig | None) -> None:
        """Raises InvalidIndex, DataplaneError where the numbers make no meter."""
        self._check(index)
        if config is not None:
            config.check()
        with self._lock:
            self._store.configure(index, None if config is None else config.rates)
            self._configs.pop(index, None)
            if config is not None:
                self._configs[index] = config


class RegisterArray(_Array):
    """A register array; values are unsigned integers of `width` bits."""

    def __init__(self, spec: ArraySpec, store: _Registers, lock: RLock) -> None:
        super().__init__(spec, lock)
        self.width = spec.width
        self._store = store

    def read(self, index: int) -> int:
        """Raises InvalidIndex."""
        self._check(index)
        with self._lock:
            return self._store.read(index)

    def write(self, index: int, value: int) -> None:
        """Raises InvalidIndex, DataplaneError where the value is too wide."""
        self._check(index)
        if not 0 <= value < 1 << self.width:
            raise DataplaneError(f"{value} does not fit the {self.width} bits of register {self.name}")
        with self._lock:
            self._store.write(index, value)

    def written(self) -> list[tuple[int, int]]:
        """(index, value) of the cells that are not 0, in order; quick for large arrays."""
        with self._lock:
            return self._store.written()


# -- hashes -----------------------------------------------------------------------------------------


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
