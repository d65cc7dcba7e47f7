"""What is wanted no more is held for a while, and rates are the highest that somebody asks for."""

import pytest

from due.bridge.remote_interests import HELD_S, RemoteInterests, rate_of
from due.messages import Assignment


def test_a_key_that_is_wanted_again_in_time_is_never_forgotten():
    remote = RemoteInterests()
    remote.assign([Assignment("a.b")], 0.0)
    remote.assign([], 1.0)
    assert list(remote.wanted(HELD_S)) == ["a.b"]
    remote.assign([Assignment("a.b")], HELD_S)
    assert list(remote.wanted(HELD_S + 2)) == ["a.b"]
    remote.assign([], 100.0)
    remote.assign([], 101.0)
    assert not remote.wanted(100.0 + HELD_S)


@pytest.mark.parametrize(
    ("assignments", "rate"),
    [
        ([Assignment("a.b", 1.0), Assignment("a.*", 4.0)], 4.0),
        ([Assignment("a.b", 1.0), Assignment("a.b", None)], None),
        ([Assignment("a.b", 1.0), Assignment("x.y", 9.0)], 1.0),
        ([Assignment("a.b:fast=yes", 2.0)], 2.0),
    ],
)
def test_a_pattern_has_the_highest_rate_of_what_it_serves(assignments, rate):
    remote = RemoteInterests()
    remote.assign(assignments, 0.0)
    assert rate_of("a.b", remote.wanted(0.0)) == rate
