"""Of several Coordinators one is active, whoever starts, stops or pauses."""

from collections.abc import Iterable

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.active_standby import ActiveStandby, Claim

STEP = 0.05


class Room:
    """Coordinators that hear each other, in steps of 50 ms."""

    def __init__(self) -> None:
        self.now = 0.0
        self.present: dict[str, ActiveStandby] = {}
        self.stopped: set[str] = set()

    def enter(self, name: str) -> None:
        self.present[name] = ActiveStandby(name, started=int(self.now * 1e9), now=self.now)

    def run(self, seconds: float) -> list[list[str]]:
        """Which ones were active in each step."""
        history = []
        for _ in range(round(seconds / STEP)):
            self.now += STEP
            for name, one in list(self.present.items()):
                if name in self.stopped:
                    continue
                claim = one.tick(self.now)
                if claim is not None:
                    self.tell(claim, self.present)
            history.append(self.active())
        return history

    def tell(self, claim: Claim, names: Iterable[str]) -> None:
        for name in names:
            if name not in self.stopped:
                self.present[name].heard(claim, self.now)

    def active(self) -> list[str]:
        return [name for name, one in self.present.items() if one.active and name not in self.stopped]


def test_one_alone_becomes_active_after_listening() -> None:
    room = Room()
    room.enter("a")
    history = room.run(1.0)
    assert history[5] == []
    assert history[-1] == ["a"]


def test_a_second_one_is_a_standby_and_says_which_one_is_active() -> None:
    room = Room()
    room.enter("b")
    room.run(1.0)
    room.enter("a")
    assert all(active == ["b"] for active in room.run(3.0))
    assert room.present["a"].active_instance == "b"


def test_two_that_start_together_agree_on_the_earlier() -> None:
    room = Room()
    room.enter("b")
    room.now += 0.01
    room.enter("a")
    history = room.run(2.0)
    assert max(map(len, history)) == 1
    assert history[-1] == ["b"]


def test_the_other_takes_over_from_one_that_dies() -> None:
    room = Room()
    room.enter("a")
    room.run(1.0)
    room.enter("b")
    room.run(1.0)
    del room.present["a"]
    assert room.run(1.0)[-1] == ["b"]


def test_one_that_resigns_is_replaced_sooner() -> None:
    room = Room()
    room.enter("a")
    room.run(1.0)
    room.enter("b")
    room.run(1.0)
    resigned = room.present.pop("a").resigned()
    room.tell(resigned, room.present)
    assert room.run(0.3)[-1] == ["b"]


def test_one_that_was_stopped_does_not_come_back_as_a_second_active_one() -> None:
    room = Room()
    room.enter("a")
    room.run(1.0)
    room.enter("b")
    room.run(1.0)
    room.stopped = {"a"}
    assert room.run(2.0)[-1] == ["b"]
    room.stopped = set()
    assert all(active == ["b"] for active in room.run(2.0))


@pytest.mark.parametrize("term", [0, 5])
def test_of_two_active_ones_the_higher_term_stays(term: int) -> None:
    one = ActiveStandby("a", started=1, now=0.0)
    for step in range(40):
        one.tick(step * STEP)
    assert one.active
    one.heard(Claim(instance_id="z", started=0, term=term, active=True), 2.0)
    assert one.active == (term < 1)


steps = st.lists(
    st.tuples(st.sampled_from(["enter", "leave", "stop", "go", "run"]), st.integers(0, 2)), max_size=30
)


@settings(max_examples=60, deadline=None)
@given(steps)
def test_whatever_happens_in_the_end_one_is_active(happenings: list[tuple[str, int]]) -> None:
    room = Room()
    room.enter("first")
    for what, number in happenings:
        name = f"c{number}"
        if what == "enter" and name not in room.present:
            room.enter(name)
        elif what == "leave":
            room.present.pop(name, None)
            room.stopped.discard(name)
        elif what == "stop" and name in room.present:
            room.stopped.add(name)
        elif what == "go":
            room.stopped.discard(name)
        else:
            room.run(0.3)
    room.stopped = set()
    room.run(3.0)
    assert len(room.active()) == 1


def test_a_claim_from_far_ahead_is_not_believed() -> None:
    """Or whoever says the highest number would keep every Coordinator from becoming active."""
    one = ActiveStandby("a", started=1, now=0.0)
    for _ in range(20):
        one.tick(one._ticked + STEP)
    assert one.active
    one.heard(Claim(instance_id="b", started=0, term=2**53, active=True), one._ticked)
    assert one.active
    for term in (2**64, -1):
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert({"instance_id": "b", "started": 0, "term": term}, Claim)
