"""The firewall's service with an engine that is none: items are handed in, what it writes is kept."""

import threading
from collections import defaultdict
from collections.abc import Callable
from typing import Any

from msgspec import structs
from reactivex import Subject

from apps.firewall.policy.rules import Rules
from apps.firewall.service import FirewallService
from apps.firewall.settings import Settings
from apps.firewall.syn.syn_policy import SynRules
from apps.messages import Confirmation, Decision
from due import Item, Key
from due.errors import ArchiveUnavailable, Timeout

NOW = 1_700_000_000_000_000_000
SWITCH = "network.switch.p4runtime_ctrl.s1"
SYNS = "network.traffic_capture.sonata.tcp:flag=syn"
SYN_ACKS = "network.traffic_capture.sonata.tcp:flag=syn+ack"
ARP = "network.traffic_capture.sonata.arp"
HANDSHAKE = "network.handshake.sonata.tcp"
ALERT = "network.anomaly.kitsune.alert"


class FakeEngine:
    """What the service uses of an engine."""

    def __init__(self) -> None:
        self.subjects: defaultdict[str, Subject[Item]] = defaultdict(Subject)
        self.written: list[tuple[str, Any]] = []
        self.archived: list[Item] = []
        self.archive_hangs: threading.Event | None = None
        self.archive_away = False
        self.disk_full = False
        self.active = True

    def observe(self, key: str) -> Subject[Item]:
        return self.subjects[key]

    def write(self, key: str, value: Any, *_: object, **__: object) -> bool:
        self.written.append((key, value))
        return True

    def flush(self, timeout: float) -> None:
        if self.disk_full:
            raise Timeout(f"not stored within {timeout} s")

    def get(self, query: object, *, limit: int | None = None) -> list[Item]:
        if self.archive_hangs is not None:
            self.archive_hangs.wait(60)
        if self.archive_away:
            raise ArchiveUnavailable("the archive is away")
        wanted = query["dataKey"] if isinstance(query, dict) else query
        tests = query.get("timestamp", {}) if isinstance(query, dict) else {}
        after, before = tests.get("$gt", 0), tests.get("$lt", 1 << 63)
        found = [
            item
            for item in self.archived
            if Key.parse(wanted).matches(Key.parse(item.key)) and after < item.timestamp < before
        ]
        return found if limit is None else found[max(0, len(found) - limit) :]


class Desk:
    """A started service; `switches` are under control from the start, and alerts decide by the rule of seconds."""

    def __init__(
        self,
        *,
        switches: tuple[str, ...] = ("s1",),
        engine: FakeEngine | None = None,
        rule: str = "seconds",
        copies: str = "all",
        **settings: Any,
    ):
        self.engine = engine or FakeEngine()
        settings["syn"] = structs.replace(settings.get("syn", SynRules()), copies=copies)
        settings["rules"] = structs.replace(settings.get("rules", Rules()), rule=rule)
        self.service = FirewallService(self.engine, Settings(**settings))  # type: ignore[arg-type]
        self.service.start()
        for switch in switches:
            self.switch(switch)

    def hand(self, key: str, value: Any, *, pattern: str = "", at: int = NOW, instance: str = "i1") -> None:
        named = key.partition(":")[0].split(".")[2]
        item = Item(key, value, at, at, "sonata_adapter" if named == "sonata" else named, instance, 1)
        self.engine.subjects[pattern or key].on_next(item)

    def switch(
        self,
        name: str = "s1",
        *,
        primary: bool = True,
        instance: str = "i1",
        at: int = NOW,
        mirror: bool = False,
    ) -> None:
        value = {"switch": name, "primary": primary, "event_time": at, "mirror": mirror}
        key = f"network.switch.p4runtime_ctrl.{name}"
        self.hand(key, value, pattern="network.switch.p4runtime_ctrl.*", instance=instance, at=at)

    def confirm(self, decision: Decision, state: str = "installed") -> None:
        said = Confirmation(
            id=decision.id,
            switch="s1",
            state=state,
            action=decision.action,
            event_time=NOW,  # type: ignore[arg-type]
        )
        pattern = "network.confirmation.p4runtime_ctrl.*"
        self.hand("network.confirmation.p4runtime_ctrl.s1", said.to_value(), pattern=pattern)

    def written(self, start: str) -> list[Any]:
        return [value for key, value in self.engine.written if key.startswith(start)]

    @property
    def decisions(self) -> list[Decision]:
        families = ("network.block.", "network.block_prefix.", "network.protect.", "network.meter.")
        return [Decision.from_value(value) for key, value in self.engine.written if key.startswith(families)]

    @property
    def blocked(self) -> list[str]:
        return [each.target.address for each in self.decisions if each.action == "block"]

    @property
    def guarded(self) -> list[str]:
        return [each.target.address for each in self.decisions if each.action == "protect"]

    @property
    def events(self) -> list[str]:
        return [value["text"] for value in self.written("network.event.")]

    def tick_until(self, condition: Callable[[], object]) -> None:
        """Ticks go on until it holds."""
        for _ in range(6000):
            self.service.tick()
            if condition():
                return
            threading.Event().wait(0.01)
        raise AssertionError("it did not come to pass within a minute")
