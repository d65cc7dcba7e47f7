"""Every strategy picks one of the candidates, and by what it says."""

import pytest

from coordinator.selection import STRATEGIES, Candidate, at_random, find, least_busy, oldest
from due.membership import Heartbeat, Registration


def candidate(name: str, started: int, written: int | None) -> Candidate:
    registration = Registration(app_id="a", instance_id=name, revision=1, heartbeat=1.0, started=started)
    if written is None:
        return registration, None
    return registration, Heartbeat(app_id="a", instance_id=name, revision=1, written=written)


CANDIDATES = [candidate("x", 3, 10), candidate("y", 1, 30), candidate("z", 2, None)]


def name(chosen: Candidate) -> str:
    return chosen[0].instance_id


def test_by_what_each_chooses() -> None:
    assert name(oldest(CANDIDATES)) == "y"
    assert name(least_busy(CANDIDATES)) == "z"
    assert name(least_busy(CANDIDATES[:2])) == "x"
    assert {name(at_random(CANDIDATES)) for _ in range(200)} == {"x", "y", "z"}


@pytest.mark.parametrize("strategy", sorted(STRATEGIES))
def test_one_candidate_is_the_choice(strategy: str) -> None:
    assert STRATEGIES[strategy](CANDIDATES[:1]) is CANDIDATES[0]


def last(candidates: list[Candidate]) -> Candidate:
    """A strategy of somebody else."""
    return candidates[-1]


def test_strategies_of_others_are_named_by_module_and_function() -> None:
    assert name(find(f"{__name__}:last")(CANDIDATES)) == "z"
    assert find("oldest") is oldest
    for wrong in ("none", "no.such.module:pick", "math:no_such"):
        with pytest.raises(ValueError, match=wrong):
            find(wrong)
