"""What travels on DUE and what apps declare: items, capabilities, interests, assignments."""

import enum
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from due.errors import InvalidOption, UnsupportedValue
from due.keys import Key

Delivery = Literal["best_effort", "reliable"]
Archive = Literal["on_demand", "always"]
Pacing = Literal["latest", "queue"]
Instances = Literal["standby", "shared", "sharded"]
Frequency = float | tuple[float, float] | None
"""Hz.  A capability's number is the most it can make; an interest's number the least it wants; a pair is
(minimum, maximum); None: every item."""


_LEAST_HZ = 1e-6
_MOST_HZ = 1e9


class Role(enum.Flag):
    """What an app does: `PRODUCER`, `CONSUMER` or `PRODUCER | CONSUMER`."""

    PRODUCER = enum.auto()
    CONSUMER = enum.auto()


class WriteFlag(int):
    """An option of one `write`, which otherwise publishes and archives, in a batch.

    An int rather than an enum: flags are combined on the hot path.
    """

    __slots__ = ()

    def __repr__(self) -> str:
        return _FLAG_NAMES.get(int(self), str(int(self)))


_FLAG_NAMES = {1: "PUB_ONLY", 2: "DB_ONLY", 4: "NO_WAIT"}

PRODUCER = Role.PRODUCER
CONSUMER = Role.CONSUMER
PUB_ONLY = WriteFlag(1)
DB_ONLY = WriteFlag(2)
NO_WAIT = WriteFlag(4)


class Item(msgspec.Struct, frozen=True, gc=False):
    """One written value.  (instance_id, key, sequence) identifies it; use that as the idempotence key."""

    key: str
    """The concrete key it was written under, canonical."""
    value: Any
    timestamp: int
    """When it was written: UTC, ns."""
    event_time: int
    """When what it describes happened: ns; equals `timestamp` unless given."""
    app_id: str
    instance_id: str
    sequence: int
    """Counts the items of (instance, key), from 1."""


def _check_rate(what: str, frequency: Frequency) -> None:
    rates = frequency if isinstance(frequency, tuple) else (frequency,)
    for rate in rates:
        if rate and not _LEAST_HZ <= rate <= _MOST_HZ:  # NaN is refused too
            raise InvalidOption(
                f"frequency {rate} of {what}: must be {_LEAST_HZ} to {_MOST_HZ:g} Hz, or None"
            )


class Capability(msgspec.Struct, frozen=True):
    """What an app can produce.  `key` may hold wildcards and the spec values on offer."""

    key: str
    frequency: Frequency = None
    """The most it can make, Hz, or (least, most)."""
    index: bool = False
    """Archive item by item with an index on `value.*` where the archive has one; else as whole frames."""
    delivery: Delivery = "best_effort"
    archive: Archive = "on_demand"
    """`always`: archived even if nobody wants it."""
    pacing: Pacing = "latest"
    """What happens to items above the assigned rate: the latest value wins, or they queue."""

    def __post_init__(self) -> None:
        Key.parse(self.key)
        _check_rate(self.key, self.frequency)


class Interest(msgspec.Struct, frozen=True):
    """What an app wants to receive."""

    key: str
    frequency: Frequency = None
    """The least it wants, Hz, or (least, most): above `most` its own DUE thins out."""

    def __post_init__(self) -> None:
        Key.parse(self.key)
        _check_rate(self.key, self.frequency)


class Assignment(msgspec.Struct, frozen=True):
    """What the Coordinator asks a producer to write under one of its capabilities."""

    key: str
    """The interest's key."""
    frequency: float | None = None
    """Items a second to write; None: unpaced."""
    epoch: Annotated[int, msgspec.Meta(ge=0, lt=2**62)] = 0
    """Grows with each change of the active instance; writes under an older one are refused."""
    capability: str = ""
    """The key of the capability it was matched with."""

    def __post_init__(self) -> None:
        Key.parse(self.key)
        _check_rate(self.key, self.frequency)


class RecordBatch(Mapping[str, npt.NDArray[Any]]):
    """Named one-dimensional columns of equal length: many records as one value.

    Columns are not copied: do not change them after `write`.  Received columns are read-only views of the
    received bytes.

    Args:
        columns: name to array, each of shape (n,), of any numpy dtype without Python objects.

    Raises:
        UnsupportedValue: a column is not one-dimensional, or the lengths differ.
    """

    __slots__ = ("_columns", "_rows")

    def __init__(self, columns: Mapping[str, npt.ArrayLike]) -> None:
        self._columns: dict[str, npt.NDArray[Any]] = {n: np.asarray(c) for n, c in columns.items()}
        lengths = {c.shape for c in self._columns.values()}
        if len(lengths) > 1 or any(len(shape) != 1 for shape in lengths):
            shapes = {n: c.shape for n, c in self._columns.items()}
            raise UnsupportedValue(f"columns of a RecordBatch are 1-d and equally long, not {shapes}")
        self._rows = next(iter(lengths))[0] if lengths else 0

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns, in order."""
        return tuple(self._columns)

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        """Number of rows."""
        return self._rows

    def __bool__(self) -> bool:
        return self._rows > 0

    def __contains__(self, name: object) -> bool:
        return name in self._columns

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, RecordBatch) or self.columns != other.columns:
            return False
        return all(
            c.dtype == other[n].dtype and np.array_equal(c, other[n], equal_nan=c.dtype.kind in "fcmM")
            for n, c in self._columns.items()
        )

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"RecordBatch({self._rows} rows: {', '.join(self._columns)})"

    def take(self, rows: Any) -> "RecordBatch":
        """Select rows.

        Args:
            rows: a slice, a bool mask of shape (n,) or an array of row numbers.

        Returns:
            A new batch with the same columns.
        """
        return RecordBatch({n: c[rows] for n, c in self._columns.items()})


class PackedFrame(msgspec.Struct, frozen=True, gc=False):
    """Consecutive items of one (instance, key) in encoded form, with the fields that archives index.

    Archives store `payload` unchanged and the other fields as columns; `due.codec.unpack(frame)` returns
    the items.
    """

    key: str
    app_id: str
    instance_id: str
    sequence: int
    """Of the first item; the others follow without a gap."""
    count: int
    first_timestamp: int
    """The least timestamp of its items, ns."""
    last_timestamp: int
    """The greatest."""
    first_event_time: int
    last_event_time: int
    index: bool
    """The capability asked for an index: archive item by item where that makes sense."""
    payload: bytes


AssignmentCallback = Callable[[tuple[Assignment, ...]], None]
