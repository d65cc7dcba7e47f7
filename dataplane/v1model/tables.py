"""Match-action tables: entries, their validation and their per-entry state."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from heapq import heappop, heappush
from threading import RLock
from typing import NamedTuple

from dataplane.compiler.machine import TableStore
from dataplane.errors import AlreadyExists, InvalidEntry, NotFound, TableError, TableFull
from dataplane.v1model.externs import CounterValue, MeterConfig
from dataplane.v1model.keys import Exact, Lpm, Match, MatchValue, Optional, Range, TableKey, Ternary
from dataplane.v1model.tree import ConstEntry, MatchKind, TableSpec

__all__ = [
    "AlreadyExists",
    "Exact",
    "InvalidEntry",
    "Lpm",
    "Match",
    "MatchValue",
    "NotFound",
    "Optional",
    "Range",
    "Table",
    "TableEntry",
    "TableError",
    "TableFull",
    "Ternary",
]

_Key = int | tuple[Match, int]
""" Packed (keys.py), or match and priority. """
_Kept = tuple[str, tuple[int, ...], int, bytes]
""" An entry without its key: action, parameters, idle time-out, metadata; no object that holds others. """


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
        self.key = TableKey(spec, store.place.shifts)
        self._packs = self.key.all_exact
        self._writable = bool(spec.keys) and not spec.is_const
        self._slots: dict[_Key, int] = {}
        self._kept: dict[int, _Kept] = {}
        self._meters: dict[_Key, MeterConfig] = {}
        self._free: list[int] = []
        # the lowest slot first, as in BMv2: it wins among equals, which exact keys never are
        self._take_free: Callable[[list[int]], int] = list.pop if self._packs else heappop
        self._give_free: Callable[[list[int], int], None] = list.append if self._packs else heappush
        self._timed: dict[_Key, int] = {}
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
        kept = (entry.action, tuple(entry.params), entry.idle_timeout_ns, entry.metadata)
        if self._packs:
            self._put(self.key.packed(entry.match, entry.priority), kept)
        else:
            self._put((entry.match, entry.priority), kept)

    def insert_packed(
        self, key: int, action: str, params: tuple[int, ...], idle_timeout_ns: int, metadata: bytes
    ) -> None:
        """`insert` for bulk writers, where all fields of the key are exact; `key` is packed (keys.py).

        Raises AlreadyExists, TableFull, InvalidEntry.
        """
        with self._lock:
            self._check_writable()
            self._put(key, (action, params, idle_timeout_ns, metadata))

    def _put(self, key: _Key, kept: _Kept) -> None:
        action, params, timeout, _ = kept
        rule = (key, self.key.mask, (), 0) if isinstance(key, int) else self.key.rule(*key)
        number = self._checked_action(action, params)
        if timeout:
            self._check_timeout(timeout)
        slots = self._slots
        if key in slots:
            raise AlreadyExists(f"table {self.name} already has an entry for {self._shown(key)}")
        if len(slots) >= self.spec.size:
            raise TableFull(f"table {self.name} is full: its size in the program is {self.spec.size}")
        slot = self._take_free(self._free) if self._free else len(slots)
        now = self._clock()
        self._store.insert(slot, rule, number, params, now)
        slots[key] = slot
        self._kept[slot] = kept
        if timeout:
            self._timed[key] = now

    def modify(self, entry: TableEntry) -> None:
        """Replace action, parameters, time-out and metadata; counters and meters are kept.

        Raises NotFound, InvalidEntry.
        """
        with self._lock:
            self._check_writable()
            kept = (entry.action, tuple(entry.params), entry.idle_timeout_ns, entry.metadata)
            number = self._checked_action(entry.action, entry.params)
            if entry.idle_timeout_ns:
                self._check_timeout(entry.idle_timeout_ns)
            key, slot = self._find(entry.match, entry.priority)
            self._store.replace(slot, number, entry.params)
            self._kept[slot] = kept
            self._timed.pop(key, None)
            if entry.idle_timeout_ns:
                self._store.touch(slot, self._clock())
                self._timed[key] = self._clock()

    def delete(self, match: Match | int, priority: int = 0) -> None:
        """Remove an entry, named by its match or its packed key.  Raises NotFound, InvalidEntry."""
        with self._lock:
            self._check_writable()
            self._remove(*self._find(match, priority))

    def _remove(self, key: _Key, slot: int) -> None:
        self._store.remove(slot)
        self._give_free(self._free, slot)
        del self._slots[key], self._kept[slot]
        self._timed.pop(key, None)
        self._meters.pop(key, None)

    def take(self, match: Match | int, priority: int = 0) -> Callable[[], None]:
        """`delete`; what it returns puts the entry back with its counter and meter."""
        with self._lock:
            self._check_writable()
            key, slot = self._find(match, priority)
            kept, meter = self._kept[slot], self._meters.get(key)
            counter = self._store.counter(slot) if self.spec.has_counter else None
            self._remove(key, slot)
        return lambda: self._put_back(key, kept, counter, meter)

    def _put_back(
        self, key: _Key, kept: _Kept, counter: tuple[int, int] | None, meter: MeterConfig | None
    ) -> None:
        with self._lock:
            self._put(key, kept)
            slot = self._slots[key]
            if counter is not None:
                self._store.set_counter(slot, *counter)
            if meter is not None:
                self._store.set_meter(slot, meter.rates)
                self._meters[key] = meter

    def get(self, match: Match, priority: int = 0) -> TableEntry | None:
        """The entry with this key, or None."""
        with self._lock:
            try:
                key, slot = self._find(match, priority)
            except TableError:
                return None
            return self._entry(key, slot)

    def entries(self) -> list[TableEntry]:
        """All entries in the order of insertion (const entries of the program too)."""
        with self._lock:
            return [self._entry(key, slot) for key, slot in self._slots.items()]

    def entries_by(self, count: int) -> Iterator[list[TableEntry]]:
        """`entries` in parts of `count`, each as it is when it is taken; packets go on in between."""
        with self._lock:
            keys = list(self._slots)
        for first in range(0, len(keys), count):
            with self._lock:
                there = ((key, self._slots.get(key)) for key in keys[first : first + count])
                part = [self._entry(key, slot) for key, slot in there if slot is not None]
            yield part

    def _entry(self, key: _Key, slot: int) -> TableEntry:
        action, params, timeout, metadata = self._kept[slot]
        match, priority = self._named(key)
        return TableEntry(match, action, params, priority, timeout, metadata)

    def __len__(self) -> int:
        return len(self._slots)

    def clear(self) -> None:
        """Remove all entries but the program's constant ones."""
        with self._lock:
            if not self.spec.is_const:
                for match, priority in map(self._named, list(self._slots)):
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
            self._store.set_default(self._checked_action(action, params), tuple(params))
            self._default = (action, tuple(params))

    def reset_default(self) -> None:
        """Back to the default action of the program."""
        with self._lock:
            self._default = self.spec.default
            if self._default is None:
                self._store.set_default(-1, ())
            else:
                action, params = self._default
                self._store.set_default(self._checked_action(action, params), params)

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
            return self._meters.get(self._find(match, priority)[0])

    def set_meter(self, match: Match, priority: int, config: MeterConfig | None) -> None:
        """Configure (or with None, clear) the direct meter of an entry.  Raises NotFound, InvalidEntry."""
        with self._lock:
            if not self.spec.has_meter:
                raise InvalidEntry(f"table {self.name} has no direct meter")
            if config is not None:
                config.check()
            key, slot = self._find(match, priority)
            self._store.set_meter(slot, None if config is None else config.rates)
            self._meters.pop(key, None)
            if config is not None:
                self._meters[key] = config

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
                since = max(reported, self._store.hit_us(slot))
                if (now_us - since) * 1000 >= self._kept[slot][2]:
                    self._timed[key] = now_us
                    result.append(self._entry(key, slot))
            return result

    # -- checks ---------------------------------------------------------------------------------------

    def _check_writable(self) -> None:
        if self._writable:
            return
        if self.spec.is_const:
            raise InvalidEntry(f"table {self.name} has constant entries")
        if not self.spec.keys:
            raise InvalidEntry(f"table {self.name} has no key: only its default action can be set")

    def _check_timeout(self, idle_timeout_ns: int) -> None:
        if not self.spec.has_idle_timeout:
            raise InvalidEntry(f"table {self.name} has no idle time-outs (support_timeout in the program)")
        if idle_timeout_ns < 0:
            raise InvalidEntry(f"table {self.name}: idle time-out of {idle_timeout_ns} ns")

    def _find(self, match: Match | int, priority: int) -> tuple[_Key, int]:
        """Key and slot of an entry.  Raises NotFound, InvalidEntry."""
        key: _Key
        if isinstance(match, int):
            key = match
        elif self._packs:
            key = self.key.packed(match, priority)
        else:
            key = (match, priority)
        slot = self._slots.get(key)
        if slot is None:
            if not isinstance(key, int):
                self.key.rule(*key)
            raise NotFound(f"table {self.name} has no entry for {self._shown(key)}")
        return key, slot

    def _slot(self, match: Match, priority: int) -> int:
        return self._find(match, priority)[1]

    def _named(self, key: _Key) -> tuple[Match, int]:
        """Match and priority of a key."""
        return (self.key.unpacked(key), 0) if isinstance(key, int) else key

    def _shown(self, key: _Key) -> str:
        return self.key.shown(*self._named(key))

    def _checked_action(self, name: str, params: Sequence[int]) -> int:
        """The action's number.  Raises InvalidEntry."""
        found = self._actions.get(name)
        if found is None:
            raise InvalidEntry(f"table {self.name} has no action {name}; it has {', '.join(self._actions)}")
        number, spec = found
        if not params and not spec.params:
            return number
        if len(params) != len(spec.params):
            raise InvalidEntry(f"action {name} takes {len(spec.params)} parameters, got {len(params)}")
        for param, value in zip(spec.params, params, strict=True):
            if not 0 <= value < 1 << param.width:
                raise InvalidEntry(f"action {name}: {param.name}={value} does not fit {param.width} bits")
        return number


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
