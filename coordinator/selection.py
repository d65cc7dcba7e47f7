"""Which instance of a standby app works.  A strategy picks once; the registry keeps its choice.

Add one with `STRATEGIES["name"] = function`; the Coordinator's setting `selection` names it.
"""

import random
from collections.abc import Callable, Sequence

from due.membership import Heartbeat, Registration

Candidate = tuple[Registration, Heartbeat | None]
Strategy = Callable[[Sequence[Candidate]], Candidate]
"""Picks one of one or more live instances of an app, sorted by instance id."""


def at_random(candidates: Sequence[Candidate]) -> Candidate:
    """Any, with equal chances."""
    return random.choice(candidates)


def oldest(candidates: Sequence[Candidate]) -> Candidate:
    """The one that started first."""
    return min(candidates, key=lambda candidate: candidate[0].started)


def least_busy(candidates: Sequence[Candidate]) -> Candidate:
    """The one that has written and received least so far."""
    return min(candidates, key=lambda candidate: _work(candidate[1]))


def _work(beat: Heartbeat | None) -> int:
    return 0 if beat is None else beat.written + beat.received


STRATEGIES: dict[str, Strategy] = {"random": at_random, "oldest": oldest, "least_busy": least_busy}
