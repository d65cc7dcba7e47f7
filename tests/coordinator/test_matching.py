"""Interests meet capabilities by key, and many consumers become one rate for a producer."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.matching import Declarations, consolidate, match
from due.keys import Key
from due.messages import Assignment, Capability, Interest

PRODUCER = "producer"


def assigned(capabilities: list[Capability], **interests: list[Interest]) -> tuple[Assignment, ...]:
    apps = {PRODUCER: Declarations(tuple(capabilities))}
    apps |= {name: Declarations(interests=tuple(wanted)) for name, wanted in interests.items()}
    return match(apps).assignments.get(PRODUCER, ())


@pytest.mark.parametrize(
    ("capability", "interest", "matches"),
    [
        ("a.b.c", "a.b.c", True),
        ("a.b.c", "a.b.d", False),
        ("a.b.c", "a.*.c", True),
        ("a.b.*", "a.b.c", True),
        ("a.**", "a.b.c.d", True),
        ("a.*.c", "a.b.*", True),
        ("a.b.c", "**", True),
        ("a.b.c", "a.b", False),
        ("a.b:flag=*", "a.b:flag=syn", True),
        ("a.b:flag=syn|ack", "a.b:flag=ack", True),
        ("a.b:flag=syn|ack", "a.b:flag=rst", False),
        ("a.b:flag=*", "a.b", True),
        ("a.b", "a.b:flag=syn", False),
        ("a.*:flag=*,dst=*", "a.b:dst=1", True),
    ],
)
def test_which_interest_meets_which_capability(capability: str, interest: str, matches: bool) -> None:
    found = assigned([Capability(capability)], consumer=[Interest(interest)])
    assert [a.key for a in found] == ([interest] if matches else [])
    assert all(a.capability == capability for a in found)


@pytest.mark.parametrize(
    ("offered", "wanted", "rate"),
    [
        (None, [None], None),
        (None, [5.0], 5.0),
        (None, [5.0, 10.0], 10.0),
        (None, [5.0, None], None),
        (20.0, [None], 20.0),
        (20.0, [5.0], 5.0),
        (20.0, [50.0], 20.0),
        (20.0, [5.0, None], 20.0),
        ((2.0, 20.0), [1.0], 2.0),
        ((2.0, 20.0), [(3.0, 4.0)], 3.0),
        (None, [(1.0, 2.0), (5.0, 9.0)], 5.0),
    ],
)
def test_many_consumers_become_one_rate(offered, wanted, rate: float | None) -> None:
    assert consolidate(offered, wanted) == rate


@given(
    st.one_of(st.none(), st.floats(0.1, 1000)),
    st.lists(st.one_of(st.none(), st.floats(0.1, 1000)), min_size=1),
)
def test_the_rate_serves_all_or_is_the_most_there_is(offered, wanted) -> None:
    rate = consolidate(offered, wanted)
    minima = [w for w in wanted if w is not None]
    if rate is None:
        assert offered is None
        assert None in wanted
    else:
        assert offered is None or rate <= offered
        assert rate == offered or all(rate >= w for w in minima)


def test_a_key_that_two_apps_want_is_assigned_once() -> None:
    found = assigned(
        [Capability("a.b")], first=[Interest("a.b", 5.0)], second=[Interest("a.b", 8.0), Interest("a.*")]
    )
    assert [(a.key, a.frequency) for a in found] == [("a.*", None), ("a.b", 8.0)]


def test_two_spellings_of_a_key_are_one_assignment() -> None:
    found = assigned(
        [Capability("a:x=*,y=*")], one=[Interest("a:x=1,y=2", 1.0)], two=[Interest("a:y=2,x=1", 3.0)]
    )
    assert [(a.key, a.frequency) for a in found] == [("a:x=1,y=2", 3.0)]


def test_asking_for_more_than_there_is_is_answered_and_served_as_well_as_possible() -> None:
    apps = {
        "p": Declarations((Capability("a.b", 10.0),)),
        "q": Declarations((Capability("a.b", 100.0),)),
        "c": Declarations(interests=(Interest("a.b", 50.0),)),
    }
    matched = match(apps)
    assert matched.assignments["p"][0].frequency == 10.0
    assert matched.assignments["q"][0].frequency == 50.0
    (event,) = matched.incompatible["c"]
    assert event.key == "a.b"
    assert "50 Hz" in event.reason
    assert "p produces a.b at most at 10 Hz" in event.reason


def test_a_variant_that_nobody_offers_is_answered() -> None:
    apps = {
        "p": Declarations((Capability("a.b:flag=syn|ack"),)),
        "c": Declarations(interests=(Interest("a.b:flag=rst"), Interest("x.y:flag=rst"))),
    }
    (event,) = match(apps).incompatible["c"]
    assert event.key == "a.b:flag=rst"


def test_the_flow_names_both_ends() -> None:
    apps = {
        "p": Declarations((Capability("a.b"),), (Interest("z"),)),
        "c": Declarations((Capability("z"),), (Interest("a.*"),)),
    }
    assert [(f.producer, f.consumer, f.interest.key) for f in match(apps).flows] == [
        ("c", "p", "z"),
        ("p", "c", "a.*"),
    ]


paths = st.lists(st.sampled_from(["a", "b", "*"]), min_size=1, max_size=3).map(".".join)


@given(st.lists(paths, max_size=4), st.lists(paths, max_size=4))
def test_matching_agrees_with_trying_every_pair(capabilities: list[str], interests: list[str]) -> None:
    found = assigned([Capability(c) for c in capabilities], c=[Interest(i) for i in interests])
    expected = {(i, c) for c in capabilities for i in interests if Key.parse(c).offers(Key.parse(i))}
    assert {(a.key, a.capability) for a in found} == expected
