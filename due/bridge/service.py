"""The bridge as a DUE app of the near site; it joins the far site by the credential that its settings name."""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple
from uuid import uuid4

import msgspec

import due.service
from due.backends import open_updates
from due.bridge.bridged_keys import BridgedKeys
from due.bridge.forwarder import FrameForwarder
from due.bridge.remote_interests import RemoteInterests, rate_of
from due.config import Options
from due.drivers.base import UpdatesDriver
from due.engine import Engine
from due.errors import EngineFailed, InvalidOption
from due.messages import CONSUMER, PRODUCER, Assignment, Capability, Interest
from due.threads import Failed

INTERESTS: tuple[Interest, ...] = ()
CAPABILITIES: tuple[Capability, ...] = ()


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a bridge."""

    far: str = ""
    """Credential file of the far site, as `sdnator app enrol` writes it."""
    to_far: tuple[str, ...] = ()
    """Key patterns of the near site that may cross to the far site."""
    to_near: tuple[str, ...] = ()
    """Key patterns of the far site that may cross to the near site."""


class BridgedSite(NamedTuple):
    """One end: where frames are read and written, and the Coordinator is told."""

    engine: Engine
    """Joined to the site, with the bridge's app id."""
    driver: UpdatesDriver
    """Of the site's Data Updates."""


class BridgeDirection:
    """What the target's apps want of the source crosses.

    Args:
        name: for logs.
        keys: what may cross.
        source: where frames come from.
        target: where they go to.
        failed: called by a thread that dies.
    """

    def __init__(
        self, name: str, keys: BridgedKeys, source: BridgedSite, target: BridgedSite, failed: Failed
    ) -> None:
        self._source, self._target = source, target
        engine = source.engine
        self._forwarder = FrameForwarder(
            name,
            keys,
            source.driver.receiver(engine.app_id, engine.instance_id),
            target.driver.publisher(engine.app_id),
            failed,
        )
        self._remote = RemoteInterests()
        self._assigned: tuple[Assignment, ...] = ()
        self._wanted: dict[str, float | None] = {}

    def start(self) -> None:
        """Offer to the target what may cross, and forward what it wants."""
        self._forwarder.start()
        offered = [Capability(key.path) for key in self._forwarder.keys.allowed]
        self._target.engine.declare(capabilities=offered)
        self._target.engine.on_assignments(self._assign)

    def tick(self, now: float) -> None:
        """Follow what the target's apps want, if this is the instance that its Coordinator asks.  `now`: s, monotonic."""
        self._forwarder.activate(self._target.engine.active)
        self._remote.assign(self._assigned, now)
        wanted = dict(self._remote.wanted(now))
        if wanted != self._wanted:
            self._wanted = wanted
            # received before it is asked for: a producer that speaks once is not missed
            patterns = self._forwarder.want(wanted)
            self._source.engine.declare(
                interests=[Interest(pattern, rate_of(pattern, wanted)) for pattern in patterns]
            )

    def health(self) -> dict[str, int]:
        """Counters."""
        return self._forwarder.health()

    def close(self) -> None:
        """Stop forwarding."""
        self._forwarder.close()

    def _assign(self, assignments: tuple[Assignment, ...]) -> None:
        self._assigned = assignments


class BridgeService:
    """Joins the engine's site with another one.

    Args:
        engine: of the near site.
        settings: the far site, and what may cross.
    """

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._settings = settings
        self._near = engine
        self._far: Engine | None = None
        self._drivers: list[UpdatesDriver] = []
        self._directions: dict[str, BridgeDirection] = {}
        self._failures: list[BaseException] = []

    def start(self) -> None:
        """Join the far site, tell both Coordinators, and begin to forward.

        Raises:
            InvalidKey: a key that may cross breaks the grammar.
            InvalidOption: no far site is named, nothing may cross, or something could cross in both directions.
            UpdatesUnavailable: the far site cannot be reached; once it was, it is waited for.
        """
        settings = self._settings
        if not settings.far:
            raise InvalidOption("settings: `far` must name the credential file of the other site")
        to_far, to_near = BridgedKeys(settings.to_far), BridgedKeys(settings.to_near)
        if not (to_far.allowed or to_near.allowed):
            raise InvalidOption("settings: nothing may cross: name keys in `to_far` or `to_near`")
        to_far.check_apart(to_near)
        options = Options.of_credential(settings.far)
        if not options.updates:
            raise InvalidOption(
                f"{settings.far} names no Data Updates: write it with `sdnator app enrol` at the other site"
            )
        self._far = Engine(options)
        self._far.when_failed = self._near.when_failed
        self._far.set_db(f"memory://bridge-{uuid4().hex}")  # it reads and writes no archive
        self._far.init(self._near.app_id, PRODUCER | CONSUMER)
        near, far = self._site(self._near), self._site(self._far)
        self._directions = {
            "to_far": BridgeDirection("near to far", to_far, near, far, self._failures.append),
            "to_near": BridgeDirection("far to near", to_near, far, near, self._failures.append),
        }
        for direction in self._directions.values():
            direction.start()

    def tick(self) -> None:
        """Follow what is wanted on both sides.

        Raises:
            EngineFailed: a thread has died.
        """
        failure = self._far.failed if self._far is not None else None
        for error in (*self._failures, *((failure,) if failure is not None else ())):
            raise EngineFailed(f"a thread of the bridge died of {type(error).__name__}: {error}") from error
        now = time.monotonic()
        for direction in self._directions.values():
            direction.tick(now)

    def stop(self) -> None:
        """Forward what was received, and leave the far site."""
        for direction in self._directions.values():
            direction.close()
        if self._far is not None:
            self._far.close()
        for driver in self._drivers:
            driver.close()

    def health(self) -> dict[str, Any]:
        """Counters of both directions, and whether the far site answers."""
        counts = {
            f"{name}_{count}": value
            for name, direction in self._directions.items()
            for count, value in direction.health().items()
        }
        return {**counts, "far_connected": self._far is not None and self._far.connected}

    def _site(self, engine: Engine) -> BridgedSite:
        driver = open_updates(engine.updates, engine.options)
        self._drivers.append(driver)
        return BridgedSite(engine, driver)


def main(argv: Sequence[str] | None = None, *, name: str = "bridge") -> int:
    """Run a bridge until a signal ends it; `name` is its app id at both sites."""
    return due.service.run(name, BridgeService, Settings, INTERESTS, CAPABILITIES, argv)
