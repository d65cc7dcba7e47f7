"""Removes passwords from output and logs.  Pure."""

import re
from collections.abc import Mapping
from typing import Any

_USERINFO = re.compile(r"(?<=://)[^/\s]*@")


def redacted(text: str) -> str:
    """The text with `…` for user and password of every URL in it."""
    return _USERINFO.sub("…@", text)


def redacted_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same for each text of a mapping, however deep."""
    return {name: _plain(value) for name, value in values.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, str):
        return redacted(value)
    if isinstance(value, Mapping):
        return redacted_values(value)
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value
