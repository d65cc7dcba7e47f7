"""Which instance of a standby app becomes active.  A strategy picks once; the registry keeps its choice.

The Coordinator's setting `selection` names one of `STRATEGIES`, or one of your own as `module:function`.
"""

import importlib
import random
from collections.abc import Callable, Sequence

from due.membership import Heartbeat, Registration

Candidate = tuple[Registration, Heartbeat | None]
Strategy = Callable[[Sequence[Candidate]], Candidate]
"""Picks one of one or more live instances of an app, sorted by instance id."""


def at_random(candidates: Sequence[Candidate]) -> Candidate:
    """Any candidate, with equal probability."""
    return random.choice(candidates)


def oldest(candidates: Sequence[Candidate]) -> Candidate:
    """The candidate that started first."""
    return min(candidates, key=lambda candidate: candidate[0].started)


def least_busy(candidates: Sequence[Candidate]) -> Candidate:
    """The candidate that has written and received the fewest items."""
    return min(candidates, key=lambda candidate: _work(candidate[1]))


def _work(beat: Heartbeat | None) -> int:
    return 0 if beat is None else beat.written + beat.received


STRATEGIES: dict[str, Strategy] = {"random": at_random, "oldest": oldest, "least_busy": least_busy}


def find(name: str) -> Strategy:
    """The strategy of this name, or `module:function`; raises ValueError."""
    if name in STRATEGIES:
        return STRATEGIES[name]
    module, colon, function = name.partition(":")
    if not colon:
        raise ValueError(
            f"selection {name!r}: must be one of {', '.join(sorted(STRATEGIES))}, or module:function"
        )
    try:
        found: Strategy = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"selection {name!r}: {error}") from None
    return found
