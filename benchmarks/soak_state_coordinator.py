"""The Coordinator's part of `benchmarks.soak_state`: its service lives hours of a soak run in minutes.

    apps: registrations, heartbeats, health ──► CoordinatorService ──► assignments, which they follow
    page, `sdnator status`, Prometheus ──► views, health, metrics
    archive at its limit ──► pruned once a minute

The archive's limit is reached when a quarter of the time is over.
"""

import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, cast

import msgspec

import coordinator.checkpoint
import coordinator.service
from benchmarks.soak_state_stage import LOOKS, START_NS, FastClock, FastEngine, watched
from coordinator import views
from coordinator.metrics import render
from coordinator.service import CAPABILITIES, CoordinatorService, Settings
from due import Engine, Item
from due.codec import encode_value
from due.drivers.sqlite import SqliteArchive
from due.membership import ASSIGNMENT, HEARTBEAT, REGISTRATION, Heartbeat, Registration
from sdnator import app_catalogue

HOURS: Final = 4.0
_ITEM_BYTES: Final = 6_000
_ITEMS: Final = 4
"""Written to the archive each second."""
_PRUNE_S: Final = 60
_VIEWS_S: Final = 30


class CoordinatorRun:
    """The service and its surroundings.

    Args:
        folder: of the archives.
        limit: bytes of the archive that is pruned.
    """

    def __init__(self, folder: Path, limit: int) -> None:
        self._clock = FastClock()
        self._clock.rule(coordinator.service, coordinator.checkpoint)
        self._engine = FastEngine("coordinator", self._clock, CAPABILITIES, folder, self._on_written)
        self._limit = limit
        # one that writes and one that prunes, as in a pipeline
        self._archives = [SqliteArchive(f"sqlite://{folder}/pruned.db") for _ in range(2)]
        self._apps = [
            _registration(name) for name in ("p4runtime_ctrl", "kitsune", "sonata_adapter", "firewall")
        ]
        self._versions: dict[str, int] = {}
        self._items = self.pruned = 0
        self.service = CoordinatorService(cast(Engine, self._engine), Settings(http=False))
        self.service.start()

    def hours(self, hours: float) -> Iterator[float]:
        """Let so many pass; how many have, from time to time."""
        for each in self._apps:
            self._hand(f"{REGISTRATION}.{each.app_id}", each.app_id, each.to_value())
        look_s = max(1, round(hours * 3600 / LOOKS))
        for second in range(round(hours * 3600)):
            for half in (0.0, 0.5):
                self._clock.seconds = second + half
                for each in self._apps:
                    self._beat(each, second)
                self.service.tick()
            for each in self._apps:
                self._hand(f"due.health.{each.app_id}", each.app_id, _health(second))
            if second % _VIEWS_S == 0:
                self._show()
            self._archive(second)
            if second % look_s == 0:
                yield second / 3600

    def health(self) -> Mapping[str, Any]:
        """Counters of the service, and of the archive."""
        found = {
            name: value for name, value in self.service.health().items() if isinstance(value, int | float)
        }
        return {**found, "pruned": self.pruned, "retained_kb": self._engine.retained_bytes >> 10}

    def _beat(self, each: Registration, second: int) -> None:
        beat = Heartbeat(
            app_id=each.app_id,
            instance_id=each.instance_id,
            state="online",
            revision=each.revision,
            version=self._versions.get(each.app_id, 0),
            written=second * 100,
            received=second * 100,
        )
        self._hand(f"{HEARTBEAT}.{each.app_id}", each.app_id, beat.to_value())

    def _hand(self, key: str, app: str, value: Any) -> None:
        self._engine.hand(key, encode_value(value), app)

    def _show(self) -> None:
        service = self.service
        now = self._clock.monotonic()
        for view in views.VIEWS.values():
            msgspec.json.encode(view(service._registry, now))
        health = service.health()
        msgspec.json.encode({**health, "apps": views.value(service._apps_health)})
        render(service._registry, health, now)

    def _archive(self, second: int) -> None:
        writing, pruning = self._archives
        items = []
        for _ in range(_ITEMS):
            self._items += 1
            at = self._clock.time_ns()
            items.append(
                Item(
                    f"network.soak.kitsune.k{self._items % 8}",
                    bytes(_ITEM_BYTES),
                    at,
                    at,
                    "kitsune",
                    "i1",
                    self._items,
                )
            )
        writing.insert(items)
        if second % _PRUNE_S == 0:
            self.pruned += pruning.prune(max_bytes=self._limit)

    def _on_written(self, key: str, value: Any) -> None:
        if key.startswith(f"{ASSIGNMENT}."):
            self._versions[value["app_id"]] = value["version"]


def _registration(name: str) -> Registration:
    app = app_catalogue.of(name)
    return Registration(
        app_id=name,
        instance_id=f"{name}1",
        instances="standby",
        revision=1,
        capabilities=app.capabilities,
        interests=app.interests,
        producer=True,
        consumer=True,
        heartbeat=0.5,
        started=START_NS,
        host="here",
        pid=1,
    )


def _health(second: int) -> dict[str, Any]:
    """As large as those of apps are."""
    counters = {f"counter{number}": second * number for number in range(60)}
    return {"app": counters, "engine": {"receiving": dict(counters), "archive": dict(counters)}}


def figures(scale: float = 1.0, *, objects: bool = False) -> dict[str, Any]:
    """Run the part.

    Args:
        scale: share of the hours.
        objects: count Python's objects, too.

    Returns:
        Figures; see `benchmarks.soak_state`.
    """
    hours = scale * HOURS
    limit = round(hours * 3600 / 4 * _ITEMS * _ITEM_BYTES)
    with tempfile.TemporaryDirectory(prefix="soak-state-") as folder:
        run = CoordinatorRun(Path(folder), limit)
        return watched(run.hours(hours), hours, run.health, objects=objects)
