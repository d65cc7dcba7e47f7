"""The registry as JSON for the HTTP API.  Pure."""

import base64
import datetime as dt
import math
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from coordinator.matching import Flow
from coordinator.registry import Registry
from due.messages import Item


def instances(registry: Registry, now: float) -> list[dict[str, Any]]:
    """Every instance with its state; `silent_s`: seconds since its last heartbeat; `shards`: those given to it."""
    given = _given(registry)
    return [
        {
            "app_id": known.registration.app_id,
            "instance_id": known.registration.instance_id,
            "state": state.value,
            "instances": known.registration.instances,
            "silent_s": round(max(0.0, now - known.seen), 3),
            "heartbeat_s": known.registration.heartbeat,
            "started": known.registration.started,
            "host": known.registration.host,
            "pid": known.registration.pid,
            "written": known.beat.written if known.beat else 0,
            "received": known.beat.received if known.beat else 0,
            "shards": given.get((known.registration.app_id, known.registration.instance_id), []),
        }
        for known, state in registry.instances()
    ]


def _given(registry: Registry) -> dict[tuple[str, str], list[str]]:
    """The shards of each instance, by app and instance."""
    given: dict[tuple[str, str], list[str]] = {}
    for app, message in registry.assignments().items():
        for shard, grant in sorted(message.shards.items()):
            given.setdefault((app, grant.instance), []).append(shard)
    return given


def apps(registry: Registry, now: float) -> list[dict[str, Any]]:
    """One entry per app: its active instance, its epoch, and the number of instances in each state."""
    told = registry.assignments()
    found: dict[str, dict[str, Any]] = {}
    for one in instances(registry, now):
        app = found.setdefault(
            one["app_id"], {"app_id": one["app_id"], "active": "", "epoch": 0, "states": {}}
        )
        app["states"][one["state"]] = app["states"].get(one["state"], 0) + 1
    for name, message in told.items():
        if name in found:
            found[name] |= {"active": message.active, "epoch": message.epoch}
    return list(found.values())


def capabilities(registry: Registry, _now: float) -> list[dict[str, Any]]:
    """Capabilities of live apps."""
    return [
        {"app_id": app} | msgspec.to_builtins(capability)
        for app, declared in registry.declarations().items()
        for capability in declared.capabilities
    ]


def interests(registry: Registry, _now: float) -> list[dict[str, Any]]:
    """Interests of live apps."""
    return [
        {"app_id": app} | msgspec.to_builtins(interest)
        for app, declared in registry.declarations().items()
        for interest in declared.interests
    ]


def assignments(registry: Registry, _now: float) -> list[dict[str, Any]]:
    """Assignments of each producer, and interests that cannot be met."""
    return [
        {
            "app_id": app,
            "active": message.active,
            "epoch": message.epoch,
            "version": message.version,
            "assignments": [msgspec.to_builtins(one) for one in message.assignments],
            "incompatible": [msgspec.to_builtins(one) for one in message.incompatible],
        }
        for app, message in registry.assignments().items()
    ]


def flow(registry: Registry, _now: float) -> list[dict[str, Any]]:
    """Which consumer gets which data from which producer."""
    return [_flow(one) for one in registry.matched.flows]


def _flow(one: Flow) -> dict[str, Any]:
    return {
        "producer": one.producer,
        "consumer": one.consumer,
        "capability": one.capability.key,
        "interest": one.interest.key,
        "delivery": one.capability.delivery,
        "frequency": one.interest.frequency,
    }


VIEWS = {
    "/apps": apps,
    "/instances": instances,
    "/capabilities": capabilities,
    "/interests": interests,
    "/assignments": assignments,
    "/flow": flow,
}
"""Path of the API to view; each is called with the registry and the time (s, monotonic)."""


def item(one: Item) -> dict[str, Any]:
    """An item under the names that queries use."""
    return {
        "dataKey": one.key,
        "value": value(one.value),
        "timestamp": one.timestamp,
        "eventTime": one.event_time,
        "appId": one.app_id,
        "instanceId": one.instance_id,
        "sequence": one.sequence,
    }


def value(one: Any) -> Any:
    """A DUE value as JSON: bytes as {"$bytes": base64}, times as ISO text, arrays as lists, NaN as text."""
    if one is None or isinstance(one, bool | int | str):
        return one
    if isinstance(one, float):
        return one if math.isfinite(one) else str(one)
    if isinstance(one, bytes | memoryview):
        return {"$bytes": base64.b64encode(one).decode()}
    if isinstance(one, dt.datetime):
        return one.isoformat()
    if isinstance(one, np.datetime64):
        return str(one)
    if isinstance(one, np.ndarray):
        return value(one.tolist() if one.dtype.kind not in "MmV" else one.astype(str).tolist())
    if isinstance(one, Mapping):
        return {str(name): value(part) for name, part in one.items()}
    if isinstance(one, list | tuple):
        return [value(part) for part in one]
    if isinstance(one, np.generic):
        return value(one.item())
    return str(one)
