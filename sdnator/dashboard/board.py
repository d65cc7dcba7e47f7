"""What the pages show: the newest of everything, bounded, whatever comes in.  Pure; thread-safe.

Each topic has a number that grows with every change, so that a page sends only what is new to it, and
any number of items between two frames costs one update.
"""

import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from apps.enforcement import SWITCHES, place_text
from apps.incidents import Incident
from apps.messages import Alert, Confirmation, Decision
from apps.talkers import TopTalkers

ALERTS_KEPT: Final = 200
DECISIONS_KEPT: Final = 500
INCIDENTS_KEPT: Final = 200
NAMES_KEPT: Final = 64
BINS: Final = 240
PARTS: Final = ("coordinator", "p4runtime_ctrl", "kitsune", "sonata_adapter", "firewall", "dashboard")
"""Apps whose absence is news; others come and go."""
OBSERVERS: Final = ("observe-", "operator", "replay")
"""Beginnings of the ids of commands: they look on, and are no apps of the pipeline."""
COSTS: Final = ("packet_in", "digests", "counts_reported", "cells_answered")
_COST_SECONDS: Final = 1.5
STANDING: Final = ("block", "protect", "meter")
EVERY_SWITCH: Final = ("", "*")


@dataclass(slots=True)
class Bin:
    """Scores that came in a slice of time."""

    start: float
    count: int = 0
    over: int = 0
    total: float = 0.0
    highest: float = 0.0


class Scores:
    """Highest and mean score by slices of wall time; old slices fall out."""

    def __init__(self, history_s: float) -> None:
        self.width = history_s / BINS
        self.bins: deque[Bin] = deque(maxlen=BINS)
        self.packets = 0

    def add(self, value: Mapping[str, Any], now: float) -> None:
        """One summary of Kitsune, come at `now` (s)."""
        start = now - now % self.width
        if not self.bins or self.bins[-1].start != start:
            self.bins.append(Bin(start))
        slot, count = self.bins[-1], int(value["count"])
        scores = value.get("score")
        slot.count += count
        slot.over += int(value["over"])
        slot.total += float(scores.sum()) if scores is not None else float(value["max"]) * count
        slot.highest = max(slot.highest, float(value["max"]))
        self.packets += count

    def rate(self, now: float, seconds: float = 5.0) -> float:
        """Packets scored a second, of late."""
        recent = [each for each in self.bins if each.start >= now - seconds]
        return sum(each.count for each in recent) / seconds


class Board:
    """The state of the pipeline as pages show it."""

    def __init__(self, history_s: float = 120.0) -> None:
        self.lock = threading.Lock()
        self.scores = Scores(history_s)
        self.alerts: deque[Alert] = deque(maxlen=ALERTS_KEPT)
        self.decisions: OrderedDict[tuple[str, str, str, int | None], Decision] = OrderedDict()
        self.answers: OrderedDict[str, str] = OrderedDict()
        """What enforcers said of decisions, by decision and place."""
        self.incidents: OrderedDict[str, Incident] = OrderedDict()
        """By id, as last reported, the one heard of last at the end."""
        self.switches: OrderedDict[str, Mapping[str, Any]] = OrderedDict()
        self.cost: OrderedDict[str, Mapping[str, float]] = OrderedDict()
        """What each switch sends to its controller a second."""
        self.talkers: OrderedDict[str, tuple[float, TopTalkers]] = OrderedDict()
        """Who sends most, by switch, and when (s) that was heard."""
        self.health: OrderedDict[str, Mapping[str, Any]] = OrderedDict()
        self.apps: list[dict[str, Any]] = []
        self.instances: list[dict[str, Any]] = []
        self.flow: list[dict[str, Any]] = []
        self.rates: dict[str, tuple[float, float]] = {}
        """Items written and received a second, by app."""
        self.key_rates: OrderedDict[tuple[str, str], Mapping[str, float]] = OrderedDict()
        """Items written a second by key without specs, by app and instance."""
        self.coordinator = ""
        """What is wrong with the Coordinator; empty: nothing."""
        self.degraded = ""
        """Parts that are away or keep dying, as `sdnator up` says; empty: none."""
        self.counts: Counter[str] = Counter()
        self.versions: Counter[str] = Counter()
        self._asked: OrderedDict[str, tuple[float, Mapping[str, Any]]] = OrderedDict()
        self._written: dict[str, tuple[float, int, int]] = {}
        self._keys: OrderedDict[tuple[str, str], tuple[float, Mapping[str, int]]] = OrderedDict()

    def score(self, value: Mapping[str, Any], now: float) -> None:
        """A score summary."""
        with self.lock:
            self.scores.add(value, now)
            self._changed("scores")

    def alert(self, alert: Alert) -> None:
        """An alert."""
        with self.lock:
            self.alerts.append(alert)
            self._changed("alerts")

    def decide(self, decisions: Iterable[Decision]) -> None:
        """Decisions, in the order they were made: the latest of a target on a switch holds."""
        with self.lock:
            for each in decisions:
                about = (each.target.kind, each.target.address, each.target.port)
                others = tuple(self.switches) if each.switch in EVERY_SWITCH else ()
                general = [self.decisions.get((switch, *about)) for switch in EVERY_SWITCH]
                if each.switch not in EVERY_SWITCH and any(
                    one and (one.id, one.action) == (each.id, each.action) for one in general
                ):
                    continue  # said again, to a switch that came later
                for switch in (*others, each.switch):
                    self.decisions.pop((switch, *about), None)
                self.decisions[each.switch, *about] = each
                while len(self.decisions) > DECISIONS_KEPT:
                    self.decisions.popitem(last=False)
                self._changed("decisions")

    def confirm(self, confirmation: Confirmation, enforcer: str = SWITCHES) -> None:
        """What an enforcer said; `enforcer` is its app id."""
        place = confirmation.switch
        with self.lock:
            where = f"switch {place}" if enforcer == SWITCHES else place_text(enforcer, place)
            name = f"{confirmation.id} {where}"
            text = confirmation.state + (f": {confirmation.cause}" if confirmation.cause else "")
            self.answers.pop(name, None)
            self.answers[name] = text
            while len(self.answers) > DECISIONS_KEPT:
                self.answers.popitem(last=False)
            self._changed("decisions")

    def incident(self, incident: Incident) -> None:
        """A report of an incident."""
        with self.lock:
            self.incidents.pop(incident.id, None)
            if not incident.joined:
                self.incidents[incident.id] = incident
            while len(self.incidents) > INCIDENTS_KEPT:
                over = (name for name, one in self.incidents.items() if one.state == "over")
                del self.incidents[next(over, next(iter(self.incidents)))]
            self._changed("incidents")

    def switch(self, value: Mapping[str, Any], now: float | None = None) -> None:
        """The state of a switch, come at `now` (s); None: it is an old one."""
        name = str(value["switch"])
        with self.lock:
            if now is not None:
                self._note_cost(name, value, now)
            _keep(self.switches, name, value)
            self._changed("switches")

    def _note_cost(self, name: str, value: Mapping[str, Any], now: float) -> None:
        then, before = self._asked.get(name, (now, value))
        if now - then >= _COST_SECONDS:
            _keep(self.cost, name, _rates(before, value, now - then))
        if name not in self._asked or now - then >= _COST_SECONDS:
            _keep(self._asked, name, (now, value))

    def talks(self, found: TopTalkers, now: float) -> None:
        """Who sends most through a switch, come at `now` (s)."""
        with self.lock:
            _keep(self.talkers, found.switch, (now, found))
            self._changed("talkers")

    def knows_switch(self, name: str) -> bool:
        """Whether it has said anything."""
        with self.lock:
            return name in self.switches

    def healthy(self, app: str, value: Mapping[str, Any], now: float) -> None:
        """What an app says of itself, at `now` (s)."""
        with self.lock:
            _keep(self.health, app, value)
            self._rate_keys(app, value.get("engine", {}), now)
            self._changed("health")

    def coordinated(
        self,
        apps: list[dict[str, Any]],
        instances: list[dict[str, Any]],
        flow: list[dict[str, Any]],
        now: float,
    ) -> None:
        """What the Coordinator says, at `now` (s)."""
        with self.lock:
            self.apps, self.instances, self.flow, self.coordinator = apps, instances, flow, ""
            self._rate(now)
            here = {one["instance_id"] for one in instances if one["state"] != "offline"}
            for name in [name for name in self.key_rates if name[1] not in here]:
                del self.key_rates[name]
            self._changed("apps")

    def supervised(self, health: Mapping[str, Mapping[str, Any]]) -> None:
        """How `sdnator up` says that its parts are."""
        away = [(name, one) for name, one in health.items() if one.get("state") in ("restarting", "degraded")]
        text = "; ".join(
            f"{name} is {one['state']}: {one.get('cause') or 'starting again'}" for name, one in away
        )
        with self.lock:
            self.degraded = text

    def uncoordinated(self, why: str) -> None:
        """The Coordinator does not answer."""
        with self.lock:
            self.coordinator = why
            self._changed("apps")

    def standing(self) -> list[Decision]:
        """Blocks and guards in force, the newest first."""
        return [each for each in reversed(self.decisions.values()) if each.action in STANDING]

    def open_incidents(self) -> int:
        """How many incidents are not over, as far as they are kept."""
        return sum(one.state == "open" for one in self.incidents.values())

    def present(self) -> list[dict[str, Any]]:
        """Apps that are here, and parts of the product that ought to be; no commands that look on."""
        return [
            app
            for app in self.apps
            if not app["app_id"].startswith(OBSERVERS)
            and (set(app["states"]) != {"offline"} or app["app_id"] in PARTS)
        ]

    def rates_by_key(self) -> dict[str, Counter[str]]:
        """Items written a second by app and key, all instances together."""
        found: dict[str, Counter[str]] = {}
        for (app, _), rates in self.key_rates.items():
            found.setdefault(app, Counter()).update(rates)
        return found

    def model(self) -> Mapping[str, Any] | None:
        """What Kitsune says of its model."""
        found = self.health.get("kitsune", {}).get("app", {}).get("model")
        return found if isinstance(found, Mapping) else None

    def threshold(self) -> float | None:
        """The score from which Kitsune calls a packet anomalous."""
        value = self.health.get("kitsune", {}).get("app", {}).get("threshold")
        return float(value) if isinstance(value, int | float) else None

    def _rate(self, now: float) -> None:
        totals: dict[str, tuple[int, int]] = {}
        for one in self.instances:
            written, received = totals.get(one["app_id"], (0, 0))
            totals[one["app_id"]] = (written + int(one["written"]), received + int(one["received"]))
        for app, (written, received) in totals.items():
            before = self._written.get(app)
            if before is not None and now > before[0]:
                seconds = now - before[0]
                # a new instance begins at 0
                rates = (written - before[1]) / seconds, (received - before[2]) / seconds
                self.rates[app] = max(0.0, rates[0]), max(0.0, rates[1])
        self._written = {app: (now, *both) for app, both in totals.items()}
        self.rates = {app: rate for app, rate in self.rates.items() if app in totals}

    def _rate_keys(self, app: str, engine: Mapping[str, Any], now: float) -> None:
        name, written = (app, str(engine.get("instance", ""))), engine.get("keys", {})
        then, before = self._keys.get(name, (now, {}))
        if now > then:
            rates = {
                key: (count - before[key]) / (now - then)
                for key, count in written.items()
                if count >= before.get(key, count + 1)
            }
            _keep(self.key_rates, name, rates)
        _keep(self._keys, name, (now, written))

    def _changed(self, topic: str) -> None:
        self.versions[topic] += 1
        self.counts[topic] += 1


def _rates(before: Mapping[str, Any], now: Mapping[str, Any], seconds: float) -> dict[str, float]:
    """What has grown a second; a controller that was restarted counts from 0 again."""
    grown = {name: int(now.get(name, 0)) - int(before.get(name, 0)) for name in COSTS}
    return {name: max(0, count) / seconds for name, count in grown.items()}


def _keep(kept: OrderedDict[Any, Any], name: Any, value: Any) -> None:
    kept[name] = value
    kept.move_to_end(name)
    while len(kept) > NAMES_KEPT:
        kept.popitem(last=False)
