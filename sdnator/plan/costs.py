"""What the parts of a pipeline cost on one machine: the file that `sdnator plan` calculates with.

sdnator plan --measure ─┐
benchmarks.cluster_plan ┴─► FILE ─► read ─► Costs ─► model.plan
"""

import math
from itertools import pairwise
from pathlib import Path

import msgspec

from sdnator.errors import BadInput

SCHEMA = 1
_MOST_BYTES = 1 << 20


class ProcessCost(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the processes of one name take."""

    per_switch: bool = False
    """There is one for each switch; otherwise one for the pipeline."""
    idle_cores: float = 0.0
    """CPU seconds a second without packets, at one switch."""
    switch_cores: float = 0.0
    """What each further switch adds to them."""
    us_per_packet: tuple[float, ...] = ()
    """Microseconds of CPU for a packet on top of that, at each of the costs' rates; empty: none."""
    us_per_query: float = 0.0
    """What each further query adds to a packet."""
    us_per_consumer: float = 0.0
    """What each further consumer of all scores adds to a packet."""
    mib: float = 0.0
    """Memory, at one switch: its share of what it has in common with other processes included."""
    switch_mib: float = 0.0
    """What each further switch adds."""


class Costs(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Unit costs, and where and when they were measured."""

    schema: int = SCHEMA
    machine: str
    """Model of its processor."""
    cores: int
    measured: str
    """Day of the measurement, as in 2026-11-25."""
    note: str = ""
    """What makes these figures better or worse than others."""
    reference_us: float = 0.0
    """CPU that the reference work took on this machine then; 0: not measured."""
    error: float | None = None
    """Largest relative difference between a prediction and a measurement; None: never compared."""
    rates: tuple[float, ...]
    """Packets a second at one switch at which the costs of a packet were measured, ascending."""
    processes: dict[str, ProcessCost]
    updates_in: tuple[float, ...] = ()
    """Bytes that Data Updates receives for a packet, at each of the rates."""
    updates_out: tuple[float, ...] = ()
    """Bytes that it sends."""
    archive: tuple[float, ...] = ()
    """Bytes that a packet takes in the archive, indexes included."""
    query_updates_in: float = 0.0
    """Bytes that each further query adds to a packet; likewise below."""
    query_updates_out: float = 0.0
    query_archive: float = 0.0
    consumer_updates_out: float = 0.0
    archive_idle: float = 0.0
    """Bytes a second that a switch without packets takes in the archive."""
    sqlite_bytes_per_s: float = 0.0
    """What SQLite takes, by itself; 0: not measured."""
    keys: int = 0
    """Paths with a writer, that is, channels and streams on Data Updates, at one switch."""
    switch_keys: int = 0
    """What each further switch adds."""
    topics: tuple[int, int] = (0, 0)
    """Topics on Kafka: reliable, best effort."""

    def __post_init__(self) -> None:
        if self.schema != SCHEMA:
            raise ValueError(f"schema {self.schema}: this version reads {SCHEMA}; measure again")
        if not self.rates or self.rates[0] <= 0 or any(one >= after for one, after in pairwise(self.rates)):
            raise ValueError("rates: must be one or more numbers above 0, ascending")
        if not self.processes:
            raise ValueError("processes: must name at least one")
        if any(not math.isfinite(each) or each < 0 for each in self._numbers()):
            raise ValueError("a cost is negative or not finite")
        if any(curve and len(curve) != len(self.rates) for curve in self._curves()):
            raise ValueError(f"each cost of a packet needs {len(self.rates)} values, one for each rate")

    def _curves(self) -> list[tuple[float, ...]]:
        own = [self.updates_in, self.updates_out, self.archive]
        return own + [each.us_per_packet for each in self.processes.values()]

    def _numbers(self) -> list[float]:
        single = [value for value in msgspec.structs.astuple(self) if isinstance(value, int | float)]
        for each in self.processes.values():
            single += [value for value in msgspec.structs.astuple(each) if isinstance(value, int | float)]
        return single + [value for curve in (self.rates, *self._curves()) for value in curve]


def read(path: Path) -> Costs:
    """The costs in a file.

    Raises:
        BadInput: it cannot be read, or holds something else.
    """
    try:
        with path.open("rb") as file:
            text = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise BadInput(f"--costs {path}: {error.strerror}; `sdnator plan --measure` writes one") from None
    if len(text) > _MOST_BYTES:
        raise BadInput(f"--costs {path}: larger than {_MOST_BYTES:,} bytes, so it is not a file of costs")
    return decoded(text, f"--costs {path}")


def decoded(text: bytes | str, name: str) -> Costs:
    """The same, from its text; `name` begins the error."""
    try:
        return msgspec.json.decode(text, type=Costs)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise BadInput(f"{name}: {error}; write it with `sdnator plan --measure`") from None


def write(path: Path, costs: Costs) -> None:
    """Write a file of costs.

    Raises:
        BadInput: it cannot be written.
    """
    try:
        path.write_bytes(msgspec.json.format(msgspec.json.encode(costs), indent=1) + b"\n")
    except OSError as error:
        raise BadInput(f"--costs {path}: cannot be written ({error.strerror}); give another file") from None
