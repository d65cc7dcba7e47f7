"""Stateful externs: counters, meters, registers.

The arrays here are the control plane's view; the state itself is the back end's (compiler/machine.py).
"""

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
