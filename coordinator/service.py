"""The Coordinator: registers apps, matches interests with capabilities, and assigns rates.

    due.registration.*, due.heartbeat.* ──► Registry ──► due.assignment.<app>
    due.leader.coordinator ◄──────────────► ActiveStandby
    HTTP on loopback ──► api.py ──► views of the registry, the archive, live data
    Retention ──► Data Archives, where a limit of age or size is set
    Checkpoints ◄──► Data Archives: what the next Coordinator may know from its start

Run it with `python -m coordinator.service`; like any app it registers, with itself.
"""

import logging
import os
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from coordinator.active_standby import ActiveStandby, Claim
from coordinator.admission import Admission
from coordinator.api import Api, Northbound
from coordinator.checkpoint import KEY as CHECKPOINT
from coordinator.checkpoint import Checkpoints
from coordinator.readers import ArchiveReaders
from coordinator.registry import Checkpoint, Registry
from coordinator.retention import Retention
from coordinator.selection import find as find_strategy
from due import NO_WAIT, PUB_ONLY, Capability, DueError, Engine, Interest, Item
from due import service as due_service
from due.backends import default_archive, open_archive
from due.backoff import LONGEST_S
from due.codec import encode_value
from due.errors import InvalidKey, InvalidOption
from due.keys import Key
from due.membership import ASSIGNMENT, HEARTBEAT, REGISTRATION, Heartbeat, Registration
from due.private_files import write_private

INTERESTS = (
    Interest(f"{REGISTRATION}.*"),
    Interest(f"{HEARTBEAT}.*"),
    Interest("due.leader.coordinator"),
    Interest("due.health.*"),
)
# due.assignment.<app> and due.leader.coordinator are not declared, so they are written without an interest
CAPABILITIES = (Capability("due.event.coordinator", archive="always", index=True),)

EVENTS = "due.event.coordinator"
_CLAIM = "due.leader.coordinator"
"""The name that version 0.1 gave it: during an upgrade, Coordinators of both versions hear each other."""
_HEALTH_BYTES = 256 << 10
TOKEN = "DUE_COORDINATOR_TOKEN"  # noqa: S105 - a variable's name
_SHORTEST_TOKEN = 16

log = logging.getLogger("coordinator")

M = TypeVar("M", Registration, Heartbeat, Claim)


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the Coordinator."""

    http: bool = True
    """Serve the HTTP API."""
    http_host: str = "127.0.0.1"
    """Address to listen on; there is no TLS, so keep it on loopback."""
    http_port: int = 0
    """0 takes a free port; `health` and the log name it."""
    token: str = ""
    """What requests bring as `Authorization: Bearer …`, those of /metrics excepted; empty: $DUE_COORDINATOR_TOKEN, and
    without that everybody may read."""
    metrics_token: str = ""
    """What requests of /metrics bring so; empty: everybody may read them."""
    readers_file: str = ""
    """Apps that may read keys from the archive by /get, with their own password as token; empty: none."""
    address_file: str = ""
    """Where to write the API's URL, with the token, once it listens; empty: nowhere."""
    selection: str = "random"
    """How the active instance of an app with standbys is chosen: random, oldest, least_busy or `module:function`."""
    missed_heartbeats: float = 4.0
    """An instance is unresponsive after this many missed heartbeats."""
    forget_s: float = 300.0
    """Seconds after which an instance that has ended is no longer listed."""
    announce_interval_s: float = 0.2
    """Seconds between announcements; an active Coordinator silent for three of them is replaced."""

    retain_s: float = 0.0
    """Age in seconds from which items are deleted from the archive; 0: never."""
    retain_bytes: int = 0
    """Size of the archive in bytes beyond which the oldest items are deleted; 0: no limit."""
    lasting_keys: tuple[str, ...] = ()
    """Keys, with wildcards, of what holds until further notice: by age it is deleted after `retain_lasting_s` only, and by
    size only what exceeds half of `retain_bytes`."""
    retain_lasting_s: float = 0.0
    """Age in seconds from which items of `lasting_keys` are deleted; 0: never."""
    retain_every_s: float = 60.0
    """Seconds between two checks of age and size."""

    def __post_init__(self) -> None:
        find_strategy(self.selection)
        for key in self.lasting_keys:
            try:
                Key.parse(key)
            except InvalidKey as error:
                raise ValueError(f"lasting_keys={key}: {error}") from error
        if not 0 <= self.http_port < 65536:
            raise ValueError(f"http_port={self.http_port}: must be 0 to 65535")


class CoordinatorService:
    """Callbacks run in the engine's thread, `tick` in the main thread, the API in its own: one lock."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._settings = settings
        self._lock = threading.Lock()
        started = time.time_ns()
        self._registry = Registry(
            engine.instance_id,
            select=find_strategy(settings.selection),
            missed=settings.missed_heartbeats,
            forget_s=settings.forget_s,
            # both grow from one Coordinator to the next, so neither has to be stored
            first_epoch=started // 1_000_000_000,
            version=started // 1_000_000,
        )
        self._admission = Admission(self._registry)
        self._standing = ActiveStandby(
            engine.instance_id, started, time.monotonic(), interval=settings.announce_interval_s
        )
        self._judge_from = 0.0
        counts = ("registrations", "heartbeats", "misunderstood", "assignments_sent", "health_refused")
        self._counts = dict.fromkeys(counts, 0)
        self._apps_health: dict[str, Any] = {}
        self._api: Api | None = None
        self._checkpoints = Checkpoints(engine)
        self._retention = Retention(
            lambda: open_archive(default_archive(engine.options)),
            lambda: self._standing.active,
            age_s=settings.retain_s,
            max_bytes=settings.retain_bytes,
            every_s=settings.retain_every_s,
            lasting_keys=(CHECKPOINT, *settings.lasting_keys),
            lasting_age_s=settings.retain_lasting_s,
        )

    def start(self) -> None:
        """Start listening; raises InvalidOption if the HTTP address is not available."""
        for key, handler in (
            (f"{REGISTRATION}.*", self._registered),
            (f"{HEARTBEAT}.*", self._beat),
            (_CLAIM, self._claimed),
            ("due.health.*", self._healthy),
        ):
            self._engine.observe(key).subscribe(handler)
        if self._settings.http:
            self._serve()
        self._retention.start()
        self._checkpoints.find(self._recall)

    def ready(self) -> dict[str, str]:
        """The URL of the HTTP API."""
        return {"http": self._api.url} if self._api is not None else {}

    def tick(self) -> None:
        """Announce this Coordinator, find silent instances, send changes.

        Without Data Updates it hears nobody and can tell nobody anything, so it judges nobody either, and not before
        the instances have had time to come back.
        """
        now = time.monotonic()
        if not self._engine.connected:
            self._judge_from = now + LONGEST_S
            return
        with self._lock:
            was_active = self._standing.active
            claim = self._standing.tick(now)
            if now >= self._judge_from:
                self._registry.expire(now)
            self._obey(was_active)
            messages = self._registry.outgoing()
            active = self._standing.active
            # wait while none is active: the next active one writes them, and the others would repeat them
            events = self._registry.events() if active or self._standing.active_instance else []
        if claim is not None:
            self._write(_CLAIM, msgspec.to_builtins(claim))
        for message in messages:
            self._write(f"{ASSIGNMENT}.{message.app_id}", message.to_value())
        self._counts["assignments_sent"] += len(messages)
        for event in events if active else ():
            log.info("%s %s %s %s", event.app_id, event.instance_id, event.kind, event.detail)
            self._engine.write(EVENTS, event.to_value())
        if active:
            self._checkpoints.write(self._registry.changes, self._checkpoint, now)

    def stop(self) -> None:
        """Stop serving; a last announcement lets another Coordinator take over at once."""
        if self._standing.active:
            self._write(_CLAIM, msgspec.to_builtins(self._standing.resigned()))
        if self._api is not None:
            self._api.stop()
        self._retention.stop()

    def health(self) -> dict[str, Any]:
        """State of this Coordinator and its counters."""
        with self._lock:
            states: dict[str, int] = {}
            for _, state in self._registry.instances():
                states[state.value] = states.get(state.value, 0) + 1
            return {
                "active": self._standing.active,
                "active_instance": self._standing.active_instance,
                "instances": states,
                "failovers": self._registry.failovers,
                "http": self._api.url if self._api is not None else "",
                "unauthorized": self._api.unauthorized if self._api is not None else 0,
                "retention_deleted": self._retention.deleted,
                "apps": self._registry.app_count(),
                "declared_keys": self._registry.declared_keys(),
                "epochs": len(self._registry.epochs()),
                "refused": self._admission.refused,
                "last_refused": [msgspec.to_builtins(one) for one in self._admission.last],
                **self._counts,
            }

    def _token(self) -> str:
        token = self._settings.token or os.environ.get(TOKEN, "")
        if token and len(token) < _SHORTEST_TOKEN:
            raise InvalidOption(
                f"the token of the HTTP API is too short: give {_SHORTEST_TOKEN} characters or more"
            )
        if not token:
            log.warning("everybody who reaches the HTTP API may read all data: set $%s", TOKEN)
        return token

    def _serve(self) -> None:
        northbound = Northbound(
            engine=self._engine,
            registry=self._registry,
            lock=self._lock,
            health=self.health,
            apps_health=lambda: self._apps_health,
            events_key=EVENTS,
        )
        try:
            self._api = Api(
                northbound,
                self._settings.http_host,
                self._settings.http_port,
                token=self._token(),
                metrics_token=self._settings.metrics_token,
                readers=ArchiveReaders(
                    Path(self._settings.readers_file) if self._settings.readers_file else None
                ),
            )
        except OSError as error:
            where = f"{self._settings.http_host}:{self._settings.http_port}"
            raise InvalidOption(
                f"HTTP API cannot listen on {where}: {error.strerror}; set http_port"
            ) from error
        self._api.start()
        log.info("HTTP API at %s", self._api.url)
        if self._settings.address_file:
            write_private(Path(self._settings.address_file), self._api.url_with_token)

    def _obey(self, was_active: bool) -> None:
        """Tell the registry whether this Coordinator is active."""
        active = self._standing.active
        if active and not self._registry.active:
            log.info("this Coordinator is active")
            self._registry.activate()
        elif not active and self._registry.active:
            self._registry.stand_by()
        if was_active and not active:
            other = self._standing.active_instance or "not yet known"
            log.warning("another Coordinator (%s) is active: this one is a standby", other)

    def _recall(self, checkpoint: Checkpoint) -> None:
        with self._lock:
            self._registry.recall(self._admission.checkpoint(checkpoint))

    def _checkpoint(self) -> Checkpoint:
        with self._lock:
            return self._registry.checkpoint()

    def _registered(self, item: Item) -> None:
        message = self._understood(item, Registration)
        if message is not None:
            self._counts["registrations"] += 1
            with self._lock:
                if self._admission.registration(message, item.app_id):
                    self._registry.registered(message, time.monotonic())

    def _beat(self, item: Item) -> None:
        message = self._understood(item, Heartbeat)
        if message is not None:
            self._counts["heartbeats"] += 1
            with self._lock:
                if self._admission.heartbeat(message, item.app_id):
                    self._registry.beat(message, time.monotonic())

    def _claimed(self, item: Item) -> None:
        claim = self._understood(item, Claim)
        if claim is None:
            return
        with self._lock:
            known, was_active = self._standing.active_instance, self._standing.active
            self._standing.heard(claim, time.monotonic())
            self._obey(was_active)
            if self._standing.active_instance != known and not was_active:
                log.warning(
                    "another Coordinator (%s) is active: this one is a standby",
                    self._standing.active_instance,
                )

    def _healthy(self, item: Item) -> None:
        with self._lock:
            self._apps_health = {a: h for a, h in self._apps_health.items() if self._registry.known(a)}
            if self._registry.known(item.app_id) and _fits(item.value):
                self._apps_health[item.app_id] = {"instance_id": item.instance_id, "health": item.value}
            else:
                self._counts["health_refused"] += 1

    def _understood(self, item: Item, kind: type[M]) -> M | None:
        try:
            return msgspec.convert(item.value, kind)
        except msgspec.ValidationError as error:
            self._counts["misunderstood"] += 1
            if self._counts["misunderstood"] == 1:
                log.warning(
                    "%s from %s was refused: %s; further ones are only counted",
                    item.key,
                    item.app_id,
                    error,
                )
            return None

    def _write(self, key: str, value: dict[str, Any]) -> None:
        try:
            self._engine.write(key, value, [PUB_ONLY, NO_WAIT])
        except DueError as error:
            log.warning("%s could not be sent: %s", key, error)


def _fits(value: Any) -> bool:
    """Whether an app's health is small enough to keep."""
    try:
        return len(encode_value(value)) <= _HEALTH_BYTES
    except DueError:
        return False


def main(argv: Sequence[str] | None = None) -> int:
    """Run until a signal; returns the exit code."""
    return due_service.run(
        "coordinator", CoordinatorService, Settings, INTERESTS, CAPABILITIES, argv, instances="shared"
    )


if __name__ == "__main__":
    sys.exit(main())
