"""What a service needs around it to live hours in minutes: a clock that is set, and an engine without threads.

    driver ──hand──► FastEngine ──► callbacks of the service                 FastClock: what the driver says it is
    service ──write──► FastEngine ──► kept as a producer of Data Updates keeps it, archived in a file ──► driver

Messages are encoded and decoded on their way, since each brings names and texts of its own then, as from the network.
"""

import gc
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from benchmarks.soak_slope import slope
from due import Assignment, Capability, Item, Key, Options
from due.codec import decode_value, encode_value
from due.drivers.redis_streams import SendWindow
from due.drivers.sqlite import SqliteArchive

START_NS: Final = 1_700_000_000_000_000_000
SECOND: Final = 1_000_000_000
SPANS: Final = 60
LOOKS: Final = 20 * SPANS
"""How often memory is looked at."""
_MOST_OBJECTS: Final = 12
_LIMITS: Final = Options()
"""Of what a producer keeps for a server that comes back empty: full within the hour, since it keeps no longer."""
_ARCHIVE_AT: Final = 200

Written = Callable[[str, Any], None]


class FastClock:
    """Stands for the module `time`: shows what it was set to."""

    def __init__(self) -> None:
        self.seconds = 0.0
        """Since the start."""

    def monotonic(self) -> float:
        """Seconds."""
        return self.seconds

    def time_ns(self) -> int:
        """Wall time, ns."""
        return START_NS + round(self.seconds * SECOND)

    def process_time(self) -> float:
        """Seconds."""
        return self.seconds

    def rule(self, *modules: ModuleType) -> None:
        """Be the `time` of these modules, in this process for good."""
        for module in modules:
            vars(module)["time"] = self


class Observed:
    """What `observe` returns."""

    def __init__(self, key: str) -> None:
        self.key = Key.parse(key)
        self.callbacks: list[Callable[[Item], Any]] = []

    def subscribe(self, callback: Callable[[Item], Any]) -> "Observed":
        """Items go there, too."""
        self.callbacks.append(callback)
        return self

    def dispose(self) -> None:
        """None do any more."""
        self.callbacks.clear()


class FastEngine:
    """What services use of an engine.

    Args:
        app: its id.
        clock: of its items.
        capabilities: those of the app that are reliable are kept, and those that are always archived are archived.
        folder: of the archive's file.
        written: is told what the service writes.
    """

    def __init__(
        self,
        app: str,
        clock: FastClock,
        capabilities: Iterable[Capability],
        folder: Path,
        written: Written = lambda _key, _value: None,
    ) -> None:
        self.app_id, self.instance_id = app, f"{app}1"
        self.options = Options(directory=str(folder), archive=f"sqlite://{folder}/{app}.db")
        self.archive = SqliteArchive(self.options.archive)
        self.active = self.connected = True
        self.when_written = written
        self._clock = clock
        self._reliable = [Key.parse(one.key) for one in capabilities if one.delivery == "reliable"]
        self._observed: list[Observed] = []
        self._routes: dict[str, list[Observed]] = {}
        self._windows: dict[str, SendWindow | None] = {}
        self._numbers: Counter[str] = Counter()
        self._waiting: list[Item] = []
        self.archived: tuple[str, ...] = ()
        """How keys begin that are archived: those that are read again."""
        self.unwanted: tuple[str, ...] = ()
        """How keys begin in which nobody has an interest."""
        self.assigned: Callable[[tuple[Assignment, ...]], None] = lambda _: None

    # -- what the service calls --------------------------------------------------------------------

    def observe(self, key: str) -> Observed:
        """As `Engine.observe`."""
        found = Observed(key)
        self._observed.append(found)
        self._routes.clear()
        return found

    def on_assignments(self, callback: Callable[[tuple[Assignment, ...]], None]) -> None:
        """As `Engine.on_assignments`; the driver calls it."""
        self.assigned = callback

    def write(self, key: str, value: Any, _flags: object = (), *, event_time: int | None = None) -> bool:
        """As `Engine.write`: readers have acknowledged it at once."""
        payload = encode_value(value)
        if self.unwanted and key.startswith(self.unwanted):
            return False
        path = key.partition(":")[0]
        self._numbers[key] += 1
        if path not in self._windows:
            kept = any(pattern.matches_path(path) for pattern in self._reliable)
            self._windows[path] = send_window(path) if kept else None
        window = self._windows[path]
        if window is not None:
            entry = window.add(payload)
            entry.id = (self._clock.time_ns() // 1_000_000, self._numbers[key])
            window.acknowledged(entry.id)
            window.trim_point(sum(each is not None for each in self._windows.values()))
        if self.archived and key.startswith(self.archived):
            self._waiting.append(self._item(key, decode_value(payload), event_time, self.app_id))
            if len(self._waiting) >= _ARCHIVE_AT:
                self.flush()
        self.when_written(key, value)
        return True

    def flush(self, _timeout: float = 0.0) -> None:
        """As `Engine.flush`."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            self.archive.insert(waiting)

    def get(self, query: str | Mapping[str, Any], *, limit: int | None = None) -> list[Item]:
        """As `Engine.get`."""
        return self.archive.find({"dataKey": query} if isinstance(query, str) else query, limit=limit)

    # -- what the driver calls ----------------------------------------------------------------------

    def hand(self, key: str, payload: bytes, app: str, event_time: int | None = None) -> None:
        """Give an item to who observes its key."""
        self._numbers[key] += 1
        item = self._item(key, decode_value(payload), event_time, app)
        if self.archived and key.startswith(self.archived):
            self._waiting.append(item)
        routes = self._routes.get(key)
        if routes is None:
            parsed = Key.parse(key)
            routes = self._routes[key] = [each for each in self._observed if each.key.matches(parsed)]
        for each in routes:
            for callback in each.callbacks:
                callback(item)

    @property
    def retained_bytes(self) -> int:
        """What a producer keeps of what it has written, for a server that comes back empty."""
        windows = [each for each in self._windows.values() if each is not None]
        return sum(entry.size for window in windows for entry in window.retained)

    def retained(self) -> dict[str, int]:
        """The same in kB by path, the largest first."""
        found = {
            path: sum(entry.size for entry in each.retained) >> 10
            for path, each in self._windows.items()
            if each is not None
        }
        return dict(sorted(found.items(), key=lambda pair: -pair[1]))

    def _item(self, key: str, value: Any, event_time: int | None, app: str) -> Item:
        now = self._clock.time_ns()
        return Item(
            key, value, now, now if event_time is None else event_time, app, f"{app}1", self._numbers[key]
        )


def send_window(path: str) -> SendWindow:
    """What a producer keeps of a path, by default."""
    return SendWindow(
        path,
        _LIMITS.window_bytes,
        _LIMITS.retain_bytes,
        _LIMITS.group_timeout,
        _LIMITS.retain_seconds,
    )


def watched(
    passed: Iterable[float], hours: float, health: Callable[[], Mapping[str, Any]], *, objects: bool = False
) -> dict[str, Any]:
    """Watch this process' memory.

    Args:
        passed: gives how many hours have passed, again and again.
        hours: how many will.
        health: counters, to be noted where the last third begins and at the end.
        objects: count Python's objects there, too.

    Returns:
        Figures; see `benchmarks.soak_state`.
    """
    least = [float("inf")] * SPANS
    notes: list[tuple[Mapping[str, Any], Counter[str]]] = []
    for at in passed:
        span = min(SPANS - 1, int(at / hours * SPANS))
        least[span] = min(least[span], anonymous_mib())
        if span >= SPANS * 2 // 3 and not notes:
            notes.append((dict(health()), _objects() if objects else Counter()))
    notes.append((dict(health()), _objects() if objects else Counter()))
    spans = [(place + 0.5, mib) for place, mib in enumerate(least) if mib < float("inf")]
    last = spans[len(spans) * 2 // 3 :]
    later = slope([place * hours / SPANS for place, _ in last], [mib for _, mib in last])
    figures: dict[str, Any] = {
        "hours": round(hours, 2),
        "mib": [round(mib, 2) for _, mib in spans],
        "later_mib_per_hour": round(later.value, 3),
        "noise": round(later.noise, 3),
        "growing": later.grows,
        "health": {"later": notes[0][0], "end": notes[-1][0]},
    }
    if objects:
        more = notes[-1][1] - notes[0][1]
        figures["more_objects"] = dict(more.most_common(_MOST_OBJECTS))
    return figures


def anonymous_mib() -> float:
    """Anonymous memory of this process."""
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("Anonymous:")) / 1024


def _objects() -> Counter[str]:
    gc.collect()
    return Counter(f"{type(each).__module__}.{type(each).__name__}" for each in gc.get_objects())
