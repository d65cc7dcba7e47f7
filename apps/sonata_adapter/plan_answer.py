"""`network.query_plan.sonata_adapter:of=KEY`: what the adapter does for a key, or would do.  Pure.

The answer is made of what is in force now, not of a plan for an empty switch.
"""

from collections.abc import Mapping
from typing import Any, Final

import msgspec

from apps.sonata_adapter.control import Control
from apps.sonata_adapter.errors import SonataError
from apps.sonata_adapter.evidence.auto_thresholds import AutoThresholds, auto_keys, auto_told
from apps.sonata_adapter.keys import QueryRequest, request_of
from apps.sonata_adapter.planner.explain import explain, match_text
from apps.sonata_adapter.planner.operators import placed_operators
from apps.sonata_adapter.planner.plan import QueryPlan
from apps.sonata_adapter.planner.refinement import coarsest
from apps.sonata_adapter.query.catalogue import Template
from due import Key
from due.errors import DueError

PLAN: Final = "network.query_plan.sonata_adapter"
OF: Final = "of"


def plan_key(key: str) -> str:
    """The key under which the adapter answers what it does for a key."""
    return Key(PLAN).with_specs(**{OF: key}).text


def asked_of(key: str) -> str:
    """The key that an interest in a plan names; empty for a wildcard."""
    parsed = Key.parse(key)
    return parsed.spec(OF) if parsed.concrete and OF in parsed.specs else ""


def plan_answer(
    key: str, control: Control, templates: Mapping[str, Template], auto: AutoThresholds | None = None
) -> dict[str, Any]:
    """What the adapter does for a key.

    Args:
        key: of a query, of a raw stream or of handshakes; any text.
        control: what is in force.
        templates: the queries that are known.
        auto: what runs at thresholds of its own.

    Returns:
        A DUE value: `state` is running, possible (nobody wants it), refused or follows (a wildcard).
    """
    try:
        if auto_keys([key]):
            return _auto_planned(key, control, templates, auto)
        request = request_of(key, templates)
    except (SonataError, DueError) as error:
        return {"key": key, "state": "refused", "reason": str(error)}
    if key in control.refused:
        return {"key": key, "state": "refused", "reason": control.refused[key]}
    if request is None:
        return {"key": key, "state": "follows", "reason": "a wildcard receives what others ask for"}
    return _planned(key, request, control, templates)


def _planned(
    key: str, request: QueryRequest, control: Control, templates: Mapping[str, Template]
) -> dict[str, Any]:
    running = any(each.identity == request.identity for each in control.requests)
    plans = control.plan if running else control.plan_beside(request)
    first = coarsest(request)
    planned = {one.identity for one in plans.queries}
    shown = first if first.identity in planned else control.count_of(request)
    one = plans.of(shown.identity)
    meaning = templates[request.name].meaning if request.kind == "query" else ""
    cells = control.cells_of(one)
    answer: dict[str, Any] = {
        "key": key,
        "state": "running" if running else "possible",
        "reason": one.reason,
        "identity": request.identity,
        "output": request.output,
        "in_switch": one.in_switch,
        "operators": [msgspec.to_builtins(each) for each in placed_operators(shown, one, cells)],
        "entries": _entries(one),
        "copies": [
            {"bit": copy.bit, "match": match_text(copy.match), "payload": copy.payload} for copy in one.copies
        ],
        "others": sum(each.identity != request.identity for each in control.requests),
        "text": explain(request, plans, meaning=meaning, count=shown.identity, cells=cells),
    }
    return answer | ({"came": control.came(one)} if running else {})


def _auto_planned(
    key: str, control: Control, templates: Mapping[str, Template], auto: AutoThresholds | None
) -> dict[str, Any]:
    """The plan of what runs for a key with `threshold=auto`, and the threshold; `SonataError` if it is refused."""
    query = auto.of(Key.parse(key).text) if auto is not None else None
    if query is None:
        beside = AutoThresholds()
        refused = beside.want([key], templates)
        query = beside.of(Key.parse(key).text)
        if query is None:
            raise SonataError(refused.get(key, f"{key} is a wildcard"))
    told = _planned(key, query.requests[-1], control, templates)
    return told | {"output": query.output, "auto": auto_told(query)}


def _entries(one: QueryPlan) -> list[dict[str, Any]]:
    return [
        {
            "table": f"ingress.count_{entry.stage}.queries",
            "bit": entry.bit,
            "role": entry.role,
            "match": match_text(entry.match),
            "cells": entry.size,
        }
        for entry in one.entries
    ]
