"""One enforcer as a separate process; the test plays the firewall.

with EnforcerRun(folder, "apps.enforcers.nftables.service", {"place": "gw"}) as run:
    run.start()
    run.decide(run.block("192.0.2.1"))
    run.wait_for("installed")
"""

import json
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Self
from uuid import uuid4

from msgspec import structs

from apps.enforcement import ALLOWED, CONFIRMED, ENFORCED, AllowedEntries, EnforcementReport
from apps.messages import Confirmation, Decision, Target
from due import CONSUMER, PRODUCER, Capability, Engine, Item, Options
from due.drivers.embedded_redis import EmbeddedServer
from sdnator.supervisor import Child
from sdnator.testing.waiting import wait_for

_SECOND = 1_000_000_000
_KEYS = ("network.block.firewall.*", "network.block_prefix.firewall.*", ALLOWED)


class EnforcerRun:
    """Data Updates, an archive, an engine that writes as the firewall, and the enforcer.

    Args:
        folder: for logs and the archive.
        module: of the enforcer, behind `python -m`.
        settings: of the enforcer.
        inside: entered around its start, for instance `RoutedLab.inside("gateway")`.
    """

    def __init__(
        self,
        folder: Path,
        module: str,
        settings: dict[str, object],
        inside: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self.folder = folder
        self._module = module
        self._settings = settings
        self._inside = inside
        self._app = module.split(".")[-2]
        self.server = EmbeddedServer(folder / "updates")
        """The Data Updates server."""
        self._archive = f"sqlite://{folder / 'archive.db'}"
        self.process: Child | None = None
        """The enforcer, while it runs."""
        self.confirmations: list[Confirmation] = []
        """All so far, in order."""
        self.reports: list[EnforcementReport] = []
        """All so far, in order."""

    def __enter__(self) -> Self:
        self.server.__enter__()
        self.engine = Engine(Options(coordinated=False, directory=str(self.folder / "due")))
        self.engine.set_pubsub(self.server.url)
        self.engine.set_db(self._archive)
        made = [Capability(key, delivery="reliable", archive="always") for key in _KEYS]
        self.engine.init("firewall", PRODUCER | CONSUMER, capabilities=made)
        self.engine.observe(f"{CONFIRMED}.{self._app}.*").subscribe(self._confirmed)
        self.engine.observe(f"{ENFORCED}.{self._app}.*").subscribe(self._reported)
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self.engine.close()
        self.server.__exit__(None, None, None)

    def start(self) -> Child:
        """Start the enforcer; returns when it is ready.

        Raises:
            PipelineError: it ended instead; the text has its last words.
        """
        options, chosen = self.folder / "engine.json", self.folder / "settings.json"
        options.write_text(json.dumps({"coordinated": False}), encoding="utf-8")
        chosen.write_text(json.dumps(self._settings), encoding="utf-8")
        command = [self._module, "--updates", self.server.url, "--archive", self._archive]
        command += ["--engine", str(options), "--settings", str(chosen)]
        command += ["--directory", str(self.folder / "due")]
        with self._inside():
            self.process = Child(self._app, command, self.folder)
        self.process.wait_ready()
        return self.process

    def stop(self) -> None:
        """End it in order; nothing where it does not run."""
        process, self.process = self.process, None
        if process is not None:
            process.stop()

    def kill(self) -> None:
        """As `kill -9` does; nothing where it does not run."""
        process, self.process = self.process, None
        if process is not None:
            process.kill()
            process.close()

    def block(self, address: str, *, seconds: float = 600.0, **more: Any) -> Decision:
        """A block of an address, prefix or MAC from now on, not told yet."""
        now = time.time_ns()
        kind = "mac" if address.count(":") == 5 and "::" not in address else "ip"
        target = Target(kind=kind, address=address)  # type: ignore[arg-type]
        fields: dict[str, Any] = {
            "id": uuid4().hex[:12],
            "action": "block",
            "switch": "*",
            "target": target,
            "reason": "a test",
            "event_time": now,
            "expires": now + int(seconds * _SECOND) if seconds else 0,
        }
        return Decision(**(fields | more))

    def decide(self, decision: Decision) -> Decision:
        """Tell it a decision, as the firewall does; returns the decision."""
        target = decision.target
        kind = "mac" if target.kind == "mac" else "ipv6" if ":" in target.address else "ipv4"
        family = "block_prefix" if "/" in target.address else "block"
        self.engine.write(f"network.{family}.firewall.{kind}", decision.to_value())
        self.engine.flush()
        return decision

    def lift(self, decision: Decision) -> None:
        """Tell it the end of a block."""
        self.decide(structs.replace(decision, action="unblock", event_time=time.time_ns()))

    def allow(self, *entries: str) -> None:
        """Tell it the whole allow-list."""
        self.engine.write(ALLOWED, AllowedEntries(entries=entries).to_value())
        self.engine.flush()

    def states(self, decision: Decision) -> list[str]:
        """What it has confirmed of a decision so far."""
        return [each.state for each in list(self.confirmations) if each.id == decision.id]

    def wait_for(self, decision: Decision, *states: str) -> None:
        """Return when its last answer about a decision is one of these.

        Raises:
            TookTooLong: with what it has said and logged.
        """
        wait_for(lambda: (self.states(decision) or [""])[-1] in states, why=self.words)

    def held(self) -> set[str]:
        """Ids of the blocks that stand, by its last report."""
        return {each.id for each in self.reports[-1].blocks} if self.reports else set()

    def words(self) -> str:
        """What it has confirmed and logged, for messages."""
        log = self.folder / f"{self._app}.log"
        said = [(each.id, each.state, each.cause) for each in self.confirmations]
        return f"{said}\n{log.read_text(encoding='utf-8') if log.exists() else ''}"

    def _confirmed(self, item: Item) -> None:
        self.confirmations.append(Confirmation.from_value(item.value))

    def _reported(self, item: Item) -> None:
        self.reports.append(EnforcementReport.from_value(item.value))
