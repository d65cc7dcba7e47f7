"""The OpenAPI document of the HTTP API.  A test compares its paths with the routes."""

from typing import Any

_LIMITS = (
    ("since", "integer", "UTC, ns: items written at this time or later"),
    ("until", "integer", "UTC, ns: items written before this time"),
    ("limit", "integer", "maximum number of items, the newest; default 1,000, at most 10,000"),
)
_PATHS: dict[str, tuple[str, str, tuple[tuple[str, str, str], ...]]] = {
    "/apps": ("Apps: the active instance, its epoch, instances by state", "List", ()),
    "/instances": ("Instances with state, host, process and counters", "List", ()),
    "/capabilities": ("Capabilities of live apps", "List", ()),
    "/interests": ("Interests of live apps", "List", ()),
    "/assignments": ("Assignments of each app; interests that cannot be met", "List", ()),
    "/flow": ("Which consumer gets which data from which producer", "List", ()),
    "/health": ("State of the Coordinator, and the last health report of every app", "Map", ()),
    "/apps/{app_id}/history": ("Events of one app: joined, activated, lost …", "Items", _LIMITS),
    "/get": (
        "Items from the archive, oldest first; an app's password gives those that it may read",
        "Items",
        (
            ("key", "string", "a DUE key, wildcards allowed"),
            ("query", "string", "a JSON object in the MongoDB dialect"),
            *_LIMITS,
        ),
    ),
    "/metrics": ("Metrics in Prometheus' text format", "", ()),
    "/openapi.json": ("This document", "Map", ()),
}
_SCHEMAS: dict[str, Any] = {
    "List": {"type": "array", "items": {"type": "object"}},
    "Map": {"type": "object"},
    "Item": {
        "type": "object",
        "properties": {
            "dataKey": {"type": "string"},
            "value": {"description": 'any JSON; bytes are {"$bytes": base64}, NaN is the text "nan"'},
            "timestamp": {"type": "integer", "description": "time of writing, UTC, ns"},
            "eventTime": {"type": "integer", "description": "when the described event happened, ns"},
            "appId": {"type": "string"},
            "instanceId": {"type": "string"},
            "sequence": {"type": "integer"},
        },
    },
    "Items": {
        "type": "object",
        "properties": {
            "items": {"type": "array", "items": {"$ref": "#/components/schemas/Item"}},
            "more": {"type": "boolean", "description": "there may be older items"},
        },
    },
    "Error": {
        "type": "object",
        "properties": {"error": {"type": "string"}, "detail": {"type": "string"}},
    },
}


def document() -> dict[str, Any]:
    """OpenAPI 3.1."""
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "SDNator Coordinator",
            "version": "1",
            "description": "Read-only. Live items: WebSocket /observe?key=…, one JSON item per message, "
            '{"missed": n} where a slow reader missed some.',
        },
        "paths": {path: {"get": _operation(path)} for path in _PATHS},
        "components": {"schemas": _SCHEMAS},
    }


def _operation(path: str) -> dict[str, Any]:
    summary, schema, parameters = _PATHS[path]
    media = (
        {"application/json": {"schema": {"$ref": f"#/components/schemas/{schema}"}}}
        if schema
        else {"text/plain": {"schema": {"type": "string"}}}
    )
    shown = [
        {"name": name, "in": "query", "required": False, "description": text, "schema": {"type": kind}}
        for name, kind, text in parameters
    ]
    if "{app_id}" in path:
        shown.insert(0, {"name": "app_id", "in": "path", "required": True, "schema": {"type": "string"}})
    error = {"application/json": {"schema": {"$ref": "#/components/schemas/Error"}}}
    return {
        "summary": summary,
        "parameters": shown,
        "responses": {
            "200": {"description": summary, "content": media},
            "400": {"description": "The request is wrong; the text says how", "content": error},
            "503": {"description": "A backend is away; trying again may help", "content": error},
        },
    }
