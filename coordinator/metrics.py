"""Prometheus metrics of the Coordinator, made from the registry when they are asked for."""

from collections import Counter
from collections.abc import Iterator
from typing import Any

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.registry import Collector

from coordinator.registry import InstanceState, Registry

_COUNTERS = {
    "registrations": "Registrations received",
    "heartbeats": "Heartbeats received",
    "misunderstood": "Membership messages that could not be decoded",
    "refused": "Membership messages refused as implausible, or beyond the limits of apps, instances or keys",
    "unauthorized": "Requests of the HTTP API that brought no token, a wrong one, or that of an app for what it may not read",
    "assignments_sent": "Assignments sent",
    "retention_deleted": "Items deleted from the archive because of its limits of age and size",
    "failovers": "Changes of the active instance because the former one was lost",
}
_SIZES = {
    "apps": "Apps that are listed",
    "declared_keys": "Capabilities and interests of all instances",
    "epochs": "Apps whose epoch is remembered",
}


class _Snapshot(Collector):
    def __init__(self, registry: Registry, health: dict[str, Any], now: float) -> None:
        self._registry = registry
        self._health = health
        self._now = now

    def collect(self) -> Iterator[Metric]:
        """The families."""
        yield GaugeMetricFamily(
            "sdnator_coordinator_active",
            "1 if this Coordinator is the active one",
            value=float(self._health["active"]),
        )
        for name, text in _COUNTERS.items():
            yield CounterMetricFamily(f"sdnator_coordinator_{name}", text, value=float(self._health[name]))
        for name, text in _SIZES.items():
            yield GaugeMetricFamily(f"sdnator_coordinator_{name}", text, value=float(self._health[name]))
        yield self._instances()
        yield from self._per_app()
        yield from self._per_instance()

    def _instances(self) -> Metric:
        family = GaugeMetricFamily("sdnator_instances", "Instances by app and state", labels=["app", "state"])
        counts = Counter((one.registration.app_id, state) for one, state in self._registry.instances())
        for app in sorted({app for app, _ in counts}):
            for state in InstanceState:
                family.add_metric([app, state.value], float(counts[app, state]))
        return family

    def _per_app(self) -> Iterator[Metric]:
        told = self._registry.assignments()
        declared = self._registry.declarations()
        for name, text, counts in (
            ("capabilities", "Declared capabilities", {a: len(d.capabilities) for a, d in declared.items()}),
            ("interests", "Declared interests", {a: len(d.interests) for a, d in declared.items()}),
            ("assignments", "Assignments in force", {a: len(m.assignments) for a, m in told.items()}),
            (
                "incompatible",
                "Interests that cannot be met",
                {a: len(m.incompatible) for a, m in told.items()},
            ),
            ("epoch", "Epoch of the active instance", {a: m.epoch for a, m in told.items()}),
        ):
            family = GaugeMetricFamily(f"sdnator_{name}", f"{text}, by app", labels=["app"])
            for app, count in counts.items():
                family.add_metric([app], float(count))
            yield family

    def _per_instance(self) -> Iterator[Metric]:
        labels = ["app", "instance"]
        silent = GaugeMetricFamily(
            "sdnator_instance_silent_seconds", "Seconds since the last heartbeat", labels=labels
        )
        written = CounterMetricFamily("sdnator_instance_items_written", "Items written", labels=labels)
        received = CounterMetricFamily("sdnator_instance_items_received", "Items received", labels=labels)
        for one, _ in self._registry.instances():
            name = [one.registration.app_id, one.registration.instance_id]
            silent.add_metric(name, max(0.0, self._now - one.seen))
            if one.beat is not None:
                written.add_metric(name, float(one.beat.written))
                received.add_metric(name, float(one.beat.received))
        yield from (silent, written, received)


def render(registry: Registry, health: dict[str, Any], now: float) -> tuple[bytes, str]:
    """Text in Prometheus' format, and its content type; `now` as in the registry."""
    collected = CollectorRegistry()
    collected.register(_Snapshot(registry, health, now))
    return generate_latest(collected), CONTENT_TYPE_LATEST
