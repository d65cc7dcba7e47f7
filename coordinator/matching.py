"""Which consumer gets which data from which producer, and at what rate.  Pure.

    declarations of the apps that live ──match()──► assignments per producer, 'incompatible' per consumer

The rate of an assignment is the highest of the consumers' minimum rates, capped by what the producer
can make; the DUE of a consumer with a lower maximum drops items above it.  A consumer without
a rate takes every item, so the producer writes as fast as it can.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

from due.keys import Key
from due.membership import Incompatible, least, most
from due.messages import Assignment, Capability, Frequency, Interest


@dataclass(frozen=True, slots=True)
class Declarations:
    """The union of what the live instances of one app declare."""

    capabilities: tuple[Capability, ...] = ()
    interests: tuple[Interest, ...] = ()


@dataclass(frozen=True, slots=True)
class Flow:
    """One interest of a consumer, served by one capability of a producer."""

    producer: str
    consumer: str
    capability: Capability
    interest: Interest


@dataclass(frozen=True, slots=True)
class Matched:
    """The result for all apps; an app without an entry gets nothing."""

    assignments: Mapping[str, tuple[Assignment, ...]] = field(default_factory=dict)
    incompatible: Mapping[str, tuple[Incompatible, ...]] = field(default_factory=dict)
    flows: tuple[Flow, ...] = ()


def match(apps: Mapping[str, Declarations]) -> Matched:
    """Match every interest with every capability; the order of `apps` does not matter."""
    flows = tuple(_flows(apps))
    wanted: dict[str, dict[tuple[Capability, str], list[Frequency]]] = defaultdict(lambda: defaultdict(list))
    for flow in flows:
        wanted[flow.producer][flow.capability, Key.parse(flow.interest.key).text].append(
            flow.interest.frequency
        )
    assignments = {
        app: tuple(
            sorted(
                (
                    Assignment(
                        key=key, frequency=consolidate(capability.frequency, rates), capability=capability.key
                    )
                    for (capability, key), rates in keys.items()
                ),
                key=lambda assignment: (assignment.key, assignment.capability),
            )
        )
        for app, keys in wanted.items()
    }
    incompatible = {app: found for app in apps if (found := tuple(_incompatible(app, apps, flows)))}
    return Matched(assignments, incompatible, flows)


def consolidate(offered: Frequency, wanted: Sequence[Frequency]) -> float | None:
    """The rate, Hz, at which a producer serves all of its consumers; None: unpaced."""
    cap = most(offered)
    minima = [least(rate) for rate in wanted]
    rates = [rate for rate in minima if rate is not None]
    if len(rates) < len(minima) or not rates:
        return cap
    rate = max(*rates, offered[0]) if isinstance(offered, tuple) else max(rates)
    return rate if cap is None else min(rate, cap)


def _flows(apps: Mapping[str, Declarations]) -> Iterator[Flow]:
    interests = [(app, interest) for app in sorted(apps) for interest in apps[app].interests]
    for producer in sorted(apps):
        for capability in apps[producer].capabilities:
            for consumer, interest in interests:
                if _offers(capability.key, interest.key):
                    yield Flow(producer, consumer, capability, interest)


def _incompatible(
    app: str, apps: Mapping[str, Declarations], flows: Sequence[Flow]
) -> Iterator[Incompatible]:
    served = set()
    for flow in flows:
        if flow.consumer != app:
            continue
        served.add(flow.interest.key)
        minimum, cap = least(flow.interest.frequency), most(flow.capability.frequency)
        if minimum is not None and cap is not None and minimum > cap:
            reason = f"at least {minimum:g} Hz wanted, but {flow.producer} produces {flow.capability.key} at most at {cap:g} Hz"
            yield Incompatible(key=flow.interest.key, reason=reason)
    for interest in apps[app].interests:
        if interest.key not in served:
            yield from _specs_refused(interest, apps)


def _specs_refused(interest: Interest, apps: Mapping[str, Declarations]) -> Iterator[Incompatible]:
    """The data exists, but not in the variant that the interest names."""
    key = Key.parse(interest.key)
    for producer in sorted(apps) if key.specs and key.exact_path else ():
        for capability in apps[producer].capabilities:
            if Key.parse(capability.key).exact_path and _offers(capability.key, key.path):
                reason = f"{producer} makes {capability.key}, which does not offer what the interest names"
                yield Incompatible(key=interest.key, reason=reason)


@lru_cache(maxsize=65536)
def _offers(capability: str, interest: str) -> bool:
    return Key.parse(capability).offers(Key.parse(interest))
