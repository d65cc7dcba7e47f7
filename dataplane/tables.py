"""Match-action tables: entries, their validation and their per-entry state.

DataplaneError (errors.py)
└── TableError
    ├── AlreadyExists    insert of a key that is there
    ├── NotFound         modify, delete or read of a key that is not
    ├── TableFull        the program's `size` is reached
    └── InvalidEntry     wrong kind, width, action, parameter, priority or a constant table
"""

from collections.abc import Callable, Mapping, Sequence
from heapq import heappop, heappush
from threading import RLock
from typing import NamedTuple

from dataplane.compiler.machine import RangePart, Row, TableStore
from dataplane.errors import DataplaneError
from dataplane.externs import CounterValue, MeterConfig
from dataplane.tree import ConstEntry, KeySpec, MatchKind, TableSpec


class TableError(DataplaneError):
    """A table operation that was refused."""


class AlreadyExists(TableError):
    """An entry with this match (and priority) is in the table."""


class NotFound(TableError):
    """No entry with this match (and priority)."""


class TableFull(TableError):
    """The table holds as many entries as the program gave it room for."""


class InvalidEntry(TableError):
    """The entry does not fit the table's key or actions."""


class Exact(NamedTuple):
    value: int


class Ternary(NamedTuple):
    """`value` under `mask`; mask 0 = any."""

    value: int
    mask: int


class Lpm(NamedTuple):
    """The first `prefix_len` bits of `value`; 0 = any."""

    value: int
    prefix_len: int


class Range(NamedTuple):
    """low <= field <= high."""

    low: int
    high: int


class Optional(NamedTuple):
    """Exactly `value`, or anything when None."""

    value: int | None


MatchValue = Exact | Ternary | Lpm | Range | Optional
Match = tuple[MatchValue, ...]


class TableEntry(NamedTuple):
    """One entry: the match values in the order of the table's key.

    priority: larger wins (P4Runtime); 0 in tables without ternary, range or optional keys
    idle_timeout_ns: 0 = never
    metadata: opaque bytes of the controller, handed back on reads
    """

    match: Match
    action: str
    params: tuple[int, ...] = ()
    priority: int = 0
    idle_timeout_ns: int = 0
    metadata: bytes = b""


class Table:
    """One table of a running switch.  Methods take the switch's lock."""

    def __init__(
        self,
        spec: TableSpec,
        store: TableStore,
        actions: Mapping[str, int],
        lock: RLock,
        clock: Callable[[], int],
    ) -> None:
        """actions: number of each action in the program; clock: packet time, µs."""
        self.name = spec.name
        self.spec = spec
        self._store = store
        self._lock = lock
        self._clock = clock
        self._actions = {a.name: (actions[a.name], a) for a in spec.actions}
        self._keys = tuple(zip(spec.keys, store.place.shifts, strict=True))
        self._full_mask = sum(((1 << k.width) - 1) << shift for k, shift in self._keys)
        self._needs_priority = spec.needs_priority
        self._only_lpm = not spec.needs_priority and any(k.kind is MatchKind.LPM for k in spec.keys)
        self._exact_widths = [k.width for k in spec.keys] if _all_exact(spec) else None
        self._slots: dict[tuple[Match, int], int] = {}
        self._entries: dict[int, TableEntry] = {}
        self._meters: dict[tuple[Match, int], MeterConfig] = {}
        self._free: list[int] = []
        self._timed: dict[tuple[Match, int], int] = {}
        self._default: tuple[str, tuple[int, ...]] | None = None
        self.reset_default()
        for entry in spec.const_entries:
            self._add(_from_program(entry, spec))

    def insert(self, entry: TableEntry) -> None:
        """Add an entry.  Raises AlreadyExists, TableFull, InvalidEntry."""
        with self._lock:
            self._check_writable()
            self._add(entry)

    def _add(self, entry: TableEntry) -> None:
        value, mask, ranges, rank = self._compiled(entry.match, entry.priority)
        number, params = self._checked_action(entry.action, entry.params)
        row = Row(value, mask, ranges, rank, number, params)
        if entry.idle_timeout_ns:
            self._check_timeout(entry)
        key = (entry.match, entry.priority)
        if key in self._slots:
            raise AlreadyExists(f"table {self.name} already has an entry for {self._shown(key)}")
        if len(self._slots) >= self.spec.size:
            raise TableFull(f"table {self.name} is full: its size in the program is {self.spec.size}")
        slot = heappop(self._free) if self._free else len(self._slots)
        self._store.insert(slot, row, self._clock())
        self._slots[key] = slot
        self._entries[slot] = entry
        if entry.idle_timeout_ns:
            self._timed[key] = self._clock()

    def modify(self, entry: TableEntry) -> None:
        """Replace action, parameters, time-out and metadata; counters and meters are kept.

        Raises NotFound, InvalidEntry.
        """
        with self._lock:
            self._check_writable()
            number, params = self._checked_action(entry.action, entry.params)
            if entry.idle_timeout_ns:
                self._check_timeout(entry)
            key = (entry.match, entry.priority)
            slot = self._slot(*key)
            self._store.replace(slot, number, params)
            self._entries[slot] = entry
            self._timed.pop(key, None)
            if entry.idle_timeout_ns:
                self._store.touch(slot, self._clock())
                self._timed[key] = self._clock()

    def delete(self, match: Match, priority: int = 0) -> None:
        """Remove an entry.  Raises NotFound, InvalidEntry."""
        with self._lock:
            self._check_writable()
            slot = self._slot(match, priority)
            self._store.remove(slot)
            key = (match, priority)
            heappush(self._free, slot)
            del self._slots[key], self._entries[slot]
            self._timed.pop(key, None)
            self._meters.pop(key, None)

    def get(self, match: Match, priority: int = 0) -> TableEntry | None:
        """The entry with this key, or None."""
        with self._lock:
            slot = self._slots.get((match, priority))
            return None if slot is None else self._entries[slot]

    def entries(self) -> list[TableEntry]:
        """All entries in the order of insertion (const entries of the program too)."""
        with self._lock:
            return [self._entries[slot] for slot in self._slots.values()]

    def __len__(self) -> int:
        return len(self._slots)

    def clear(self) -> None:
        """Remove all entries but the program's constant ones."""
        with self._lock:
            if not self.spec.is_const:
                for match, priority in list(self._slots):
                    self.delete(match, priority)

    # -- default action -------------------------------------------------------------------------------

    @property
    def default(self) -> tuple[str, tuple[int, ...]] | None:
        """(action, params) run on a miss, or None."""
        return self._default

    def set_default(self, action: str, params: Sequence[int] = ()) -> None:
        """Replace the default action.  Raises InvalidEntry where it is constant or does not fit."""
        with self._lock:
            if self.spec.default_is_const:
                raise InvalidEntry(f"the default action of table {self.name} is constant")
            number, checked = self._checked_action(action, params)
            self._store.set_default(number, checked)
            self._default = (action, tuple(checked))

    def reset_default(self) -> None:
        """Back to the default action of the program."""
        with self._lock:
            self._default = self.spec.default
            if self._default is None:
                self._store.set_default(-1, ())
            else:
                self._store.set_default(*self._checked_action(*self._default))

    # -- per-entry state ------------------------------------------------------------------------------

    def counter(self, match: Match, priority: int = 0) -> CounterValue:
        """Direct counter of an entry (zero where the table has none).  Raises NotFound."""
        with self._lock:
            slot = self._slot(match, priority)
            return CounterValue(*self._store.counter(slot)) if self.spec.has_counter else CounterValue()

    def set_counter(self, match: Match, priority: int, value: CounterValue) -> None:
        """Write (or reset) the direct counter of an entry.  Raises NotFound, InvalidEntry."""
        with self._lock:
            if not self.spec.has_counter:
                raise InvalidEntry(f"table {self.name} has no direct counter")
            self._store.set_counter(self._slot(match, priority), value.packets, value.bytes)

    def meter(self, match: Match, priority: int = 0) -> MeterConfig | None:
        """Direct meter configuration of an entry, None = unconfigured (always green).  Raises NotFound."""
        with self._lock:
            self._slot(match, priority)
            return self._meters.get((match, priority))

    def set_meter(self, match: Match, priority: int, config: MeterConfig | None) -> None:
        """Configure (or with None, clear) the direct meter of an entry.  Raises NotFound, InvalidEntry."""
        with self._lock:
            if not self.spec.has_meter:
                raise InvalidEntry(f"table {self.name} has no direct meter")
            if config is not None:
                config.check()
            slot = self._slot(match, priority)
            self._store.set_meter(slot, None if config is None else config.rates)
            self._meters.pop((match, priority), None)
            if config is not None:
                self._meters[match, priority] = config

    def idle_ns(self, match: Match, priority: int, now_us: int) -> int:
        """Time since the last hit (or insertion), ns.  Raises NotFound."""
        with self._lock:
            return max(0, now_us - self._store.hit_us(self._slot(match, priority))) * 1000

    def expired(self, now_us: int) -> list[TableEntry]:
        """Entries unhit for their time-out since the last hit, insertion or report."""
        with self._lock:
            result = []
            for key, reported in self._timed.items():
                slot = self._slots[key]
                entry = self._entries[slot]
                since = max(reported, self._store.hit_us(slot))
                if (now_us - since) * 1000 >= entry.idle_timeout_ns:
                    self._timed[key] = now_us
                    result.append(entry)
            return result

    # -- checks ---------------------------------------------------------------------------------------

    def _check_writable(self) -> None:
        if self.spec.is_const:
            raise InvalidEntry(f"table {self.name} has constant entries")
        if not self.spec.keys:
            raise InvalidEntry(f"table {self.name} has no key: only its default action can be set")

    def _check_timeout(self, entry: TableEntry) -> None:
        if not self.spec.has_idle_timeout:
            raise InvalidEntry(f"table {self.name} has no idle time-outs (support_timeout in the program)")
        if entry.idle_timeout_ns < 0:
            raise InvalidEntry(f"table {self.name}: idle time-out of {entry.idle_timeout_ns} ns")

    def _slot(self, match: Match, priority: int) -> int:
        slot = self._slots.get((match, priority))
        if slot is None:
            self._compiled(match, priority)
            raise NotFound(f"table {self.name} has no entry for {self._shown((match, priority))}")
        return slot

    def _shown(self, key: tuple[Match, int]) -> str:
        fields = ", ".join(f"{spec.name}={m}" for (spec, _), m in zip(self._keys, key[0], strict=False))
        return f"({fields})" + (f" at priority {key[1]}" if key[1] else "")

    def _checked_action(self, name: str, params: Sequence[int]) -> tuple[int, tuple[int, ...]]:
        found = self._actions.get(name)
        if found is None:
            raise InvalidEntry(f"table {self.name} has no action {name}; it has {', '.join(self._actions)}")
        number, spec = found
        if not params and not spec.params:
            return number, ()
        if len(params) != len(spec.params):
            raise InvalidEntry(f"action {name} takes {len(spec.params)} parameters, got {len(params)}")
        for param, value in zip(spec.params, params, strict=True):
            if not 0 <= value < 1 << param.width:
                raise InvalidEntry(f"action {name}: {param.name}={value} does not fit {param.width} bits")
        return number, tuple(params)

    def _compiled(self, match: Match, priority: int) -> tuple[int, int, tuple[RangePart, ...], int]:
        """Value, mask, ranges and rank for the store.  Raises InvalidEntry."""
        if len(match) != len(self._keys):
            raise InvalidEntry(f"table {self.name} has {len(self._keys)} key fields, got {len(match)}")
        self._check_priority(priority)
        if self._exact_widths is not None:
            return self._compiled_exact(match, self._exact_widths), self._full_mask, (), 0
        value = mask = 0
        rank = priority
        ranges: list[RangePart] = []
        for (spec, shift), m in zip(self._keys, match, strict=True):
            if isinstance(m, Range):
                ranges.extend(self._range(spec, shift, m))
                continue
            v, k = self._value_and_mask(spec, m)
            value |= v << shift
            mask |= k << shift
            if self._only_lpm and isinstance(m, Lpm):
                rank = m.prefix_len
        return value, mask, tuple(ranges), rank

    def _compiled_exact(self, match: Match, widths: Sequence[int]) -> int:
        compiled = 0
        for (spec, shift), width, m in zip(self._keys, widths, match, strict=True):
            value: int = m[0] if m.__class__ is Exact else self._value_and_mask(spec, m)[0]
            if value >> width:
                self._value_and_mask(spec, m)
            compiled |= value << shift
        return compiled

    def _check_priority(self, priority: int) -> None:
        if self._needs_priority and priority < 1:
            raise InvalidEntry(f"table {self.name} needs a priority of at least 1, got {priority}")
        if not self._needs_priority and priority:
            raise InvalidEntry(f"table {self.name} takes no priority, got {priority}")
        if priority >= 1 << 31:
            raise InvalidEntry(f"table {self.name}: priority {priority} does not fit 31 bits")

    def _range(self, spec: KeySpec, shift: int, m: Range) -> list[RangePart]:
        full = (1 << spec.width) - 1
        if spec.kind is not MatchKind.RANGE:
            raise self._wrong_kind(spec, m)
        if not 0 <= m.low <= m.high <= full:
            raise InvalidEntry(
                f"table {self.name}: {spec.name} range {m.low}..{m.high} is not within 0..{full}"
            )
        return [] if (m.low, m.high) == (0, full) else [RangePart(shift, spec.width, m.low, m.high)]

    def _wrong_kind(self, spec: KeySpec, m: MatchValue) -> InvalidEntry:
        return InvalidEntry(f"table {self.name}: {spec.name} is matched {spec.kind}, got {m}")

    def _value_and_mask(self, spec: KeySpec, m: MatchValue) -> tuple[int, int]:
        full = (1 << spec.width) - 1
        if not isinstance(m, _KINDS[spec.kind]):
            raise self._wrong_kind(spec, m)
        value, mask = 0, full
        if isinstance(m, Exact):
            value = m.value
        elif isinstance(m, Optional):
            value, mask = (0, 0) if m.value is None else (m.value, full)
        elif isinstance(m, Ternary):
            value, mask = m.value, m.mask
        elif isinstance(m, Lpm):
            if not 0 <= m.prefix_len <= spec.width:
                raise InvalidEntry(f"table {self.name}: {spec.name} prefix length {m.prefix_len}")
            value, mask = m.value, full ^ (full >> m.prefix_len)
        if not (0 <= value <= full and 0 <= mask <= full):
            raise InvalidEntry(f"table {self.name}: {spec.name}={m} does not fit {spec.width} bits")
        if value & ~mask:
            raise InvalidEntry(f"table {self.name}: {spec.name}={m} has bits set outside its mask")
        return value, mask


def _all_exact(spec: TableSpec) -> bool:
    return all(key.kind is MatchKind.EXACT for key in spec.keys)


_KINDS: dict[MatchKind, type[MatchValue]] = {
    MatchKind.EXACT: Exact,
    MatchKind.LPM: Lpm,
    MatchKind.TERNARY: Ternary,
    MatchKind.RANGE: Range,
    MatchKind.OPTIONAL: Optional,
}


def _from_program(entry: ConstEntry, spec: TableSpec) -> TableEntry:
    """A constant entry as an ordinary one."""
    match: list[MatchValue] = []
    for (kind, value, second), key in zip(entry.keys, spec.keys, strict=True):
        if kind is MatchKind.EXACT:
            match.append(Exact(value))
        elif kind is MatchKind.LPM:
            match.append(Lpm(value, second))
        elif kind is MatchKind.TERNARY:
            match.append(Ternary(value & second, second))
        elif kind is MatchKind.RANGE:
            match.append(Range(value, second))
        else:
            match.append(Optional(value if second == (1 << key.width) - 1 else None))
    priority = entry.priority if spec.needs_priority else 0
    return TableEntry(tuple(match), entry.action, entry.params, priority)
