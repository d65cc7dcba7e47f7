"""Asks the running Sonata adapter what it does for a key, over Data Updates."""

import queue
import time
from collections.abc import Mapping
from typing import Any, Final

from sdnator.cli.live_items import live_items
from sdnator.errors import PipelineError

_SECONDS: Final = 30.0
_PREFIXES: Final = (
    "network.traffic_query.sonata.",
    "network.traffic_capture.sonata.",
    "network.handshake.sonata.",
)


def is_asked_of_adapter(key: str) -> bool:
    """Whether the Sonata adapter would make the data of this key."""
    return key.startswith(_PREFIXES)


def ask_plan(key: str, url: str, *, answers: int = 1) -> list[Mapping[str, Any]]:
    """What the adapter does for a key, or would do.

    Args:
        key: canonical.
        url: of Data Updates.
        answers: how many to wait for; they come once a second.

    Raises:
        PipelineError: it does not answer.
    """
    from apps.sonata_adapter.plan_answer import plan_key

    found: list[Mapping[str, Any]] = []
    deadline = time.monotonic() + _SECONDS + answers
    with live_items([plan_key(key)], url) as (waiting, _):
        while len(found) < answers:
            try:
                item = waiting.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise PipelineError(
                    f"the Sonata adapter did not answer within {_SECONDS:g} s; see `sdnator status`"
                ) from None
            found.append(item.value)
    return found
