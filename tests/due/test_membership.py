"""A member buffers, then works alone or as assigned; it never speaks under an older epoch or while in doubt."""

from contextlib import suppress

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from due.keys import Key
from due.membership import (
    Assignments,
    Heartbeat,
    Incompatible,
    Member,
    Phase,
    Registration,
    ShardGrant,
    Verdict,
)
from due.messages import Assignment, Capability, Interest

PACKETS = Capability("n.packets.ctrl.**", frequency=50.0)
KEY = Key("n.packets.ctrl.s1.all")


def _member(**options) -> Member:
    registration = Registration(
        app_id="ctrl", instance_id="me", revision=1, capabilities=(PACKETS,), heartbeat=0.5, started=1
    )
    return Member(registration, now=0.0, handshake_timeout=1.0, **options)


def _assignments(**changes) -> Assignments:
    fields = {
        "app_id": "ctrl",
        "coordinator": "c",
        "version": 1,
        "epoch": 1,
        "active": "me",
        "revisions": {"me": 1},
    }
    return Assignments(**{**fields, **changes})


def _wants(key: str, frequency: float | None = None) -> Assignment:
    return Assignment(key, frequency, 1, PACKETS.key)


def test_it_registers_and_beats_at_its_rate():
    member = _member()
    assert [type(m) for m in member.tick(0.0)] == [Registration, Heartbeat]
    assert member.tick(0.3) == []
    assert [type(m) for m in member.tick(0.5)] == [Heartbeat]
    member.declare(0.6, interests=(Interest("a.b"),))
    assert member.next_tick() == 0.6
    (registration,) = member.tick(0.6)
    assert isinstance(registration, Registration)
    assert (registration.revision, registration.interests) == (2, (Interest("a.b"),))


def test_without_a_coordinator_it_buffers_then_works_alone():
    member = _member()
    assert member.permission(KEY).verdict is Verdict.BUFFER
    assert not member.wanted(KEY)
    assert not member.reading
    member.tick(1.0)
    assert member.phase is Phase.ALONE
    assert member.permission(KEY).verdict is Verdict.OPEN
    assert member.permission(KEY).frequency == 50.0
    assert member.wanted(KEY)
    assert member.reading


class _Instances:
    """Instances of one app, without a Coordinator; time by hand, heartbeats as Data Updates carry them."""

    def __init__(self) -> None:
        self.now = 0.0
        self.members: dict[str, Member] = {}
        self.cut: set[str] = set()

    def start(self, name: str, *, instances: str = "standby") -> None:
        registration = Registration(
            app_id="ctrl",
            instance_id=name,
            revision=1,
            capabilities=(PACKETS,),
            heartbeat=0.5,
            started=1,
            instances=instances,  # type: ignore[arg-type]
        )
        self.members[name] = Member(registration, now=self.now, handshake_timeout=1.0)

    def run(self, seconds: float) -> set[frozenset[str]]:
        """Which instances worked at once, at any time."""
        seen = set()
        end = self.now + seconds
        while self.now < end:
            self.now += 0.1
            for name, member in self.members.items():
                member.connection(self.now, works=name not in self.cut)
                for message in member.tick(self.now):
                    if isinstance(message, Heartbeat) and name not in self.cut:
                        for other in self.members.keys() - self.cut:
                            self.members[other].heard(message, self.now)
            seen.add(
                frozenset(n for n, m in self.members.items() if m.permission(KEY).verdict is Verdict.OPEN)
            )
        return seen

    def working(self) -> list[str]:
        return [name for name, member in self.members.items() if member.reading]


def test_of_two_standbys_without_a_coordinator_one_works():
    """Both start while the Coordinator is away; the other takes over when the one is silent."""
    site = _Instances()
    site.start("bob")
    site.start("ann")
    assert site.run(60.0) == {frozenset(), frozenset({"ann"})}
    del site.members["ann"]
    assert site.run(10.0) == {frozenset(), frozenset({"bob"})}
    site.start("ann")
    assert site.run(10.0) == {frozenset({"bob"})}, "one that works goes on"


def test_a_standby_that_starts_beside_one_that_a_coordinator_named_waits():
    site = _Instances()
    site.start("zoe")
    site.members["zoe"].assigned(
        _assignments(active="zoe", revisions={"zoe": 1}, assignments=(_wants("n.**"),)), 0.0
    )
    site.start("ann")
    assert site.run(10.0) == {frozenset({"zoe"})}


def test_two_that_were_cut_off_from_each_other_do_not_both_go_on():
    site = _Instances()
    site.start("ann")
    site.start("bob")
    site.run(3.0)
    assert site.working() == ["ann"]
    site.cut = {"ann"}
    assert site.members["ann"].paused(site.now)
    assert all(len(working) < 2 for working in site.run(10.0))
    assert site.working() == ["bob"]
    site.cut = set()
    assert all(len(working) < 2 for working in site.run(10.0))
    assert len(site.working()) == 1


def test_shared_instances_all_work():
    site = _Instances()
    for name in ("ann", "bob"):
        site.start(name, instances="shared")
    site.run(3.0)
    assert site.working() == ["ann", "bob"]


def test_undeclared_keys_are_always_open():
    assert _member().permission(Key("other.key")).verdict is Verdict.OPEN


def test_an_uncoordinated_member_is_silent():
    member = _member(coordinated=False)
    assert member.tick(0.0) == []
    assert member.permission(KEY).verdict is Verdict.OPEN


def test_only_what_is_wanted_is_open():
    member = _member()
    assert member.assigned(_assignments(), 0.1)
    assert member.permission(KEY).verdict is Verdict.UNWANTED
    assert member.assigned(_assignments(assignments=(_wants("n.packets.*.s1.**"),)), 0.2)
    assert member.permission(KEY).verdict is Verdict.OPEN
    assert member.permission(Key("n.packets.ctrl.s2.all")).verdict is Verdict.UNWANTED
    assert member.wanted(Key("n.packets.ctrl.s1.7"))
    assert member.wanted(Key("n.packets.ctrl.**"))
    assert not member.wanted(Key("n.packets.ctrl.s2.*"))


@pytest.mark.parametrize(
    ("wanted", "rate"), [([10.0, 20.0], 20.0), ([10.0, None], 50.0), ([None], 50.0), ([5.0], 5.0)]
)
def test_the_rate_is_the_highest_wanted(wanted, rate):
    member = _member()
    member.assigned(_assignments(assignments=tuple(_wants("n.packets.**", f) for f in wanted)), 0.1)
    assert member.permission(KEY).frequency == rate


def test_it_registers_again_when_the_coordinator_does_not_know_it():
    member = _member()
    member.tick(0.0)
    assert not member.assigned(_assignments(revisions={}), 0.1)
    assert member.phase is Phase.WAITING
    assert [type(m) for m in member.tick(0.1)] == [Registration, Heartbeat]
    member.assigned(_assignments(revisions={"me": 0}), 0.2)
    assert [type(m) for m in member.tick(0.2)] == [Registration]


def test_a_standby_instance_neither_speaks_nor_reads():
    member = _member()
    member.assigned(_assignments(active="other", assignments=(_wants("n.**"),)), 0.1)
    assert member.permission(KEY).verdict is Verdict.REFUSED
    assert member.permission(Key("other.key")).verdict is Verdict.REFUSED
    assert not member.reading
    assert member.assignments == ()
    member.assigned(_assignments(epoch=2, assignments=(_wants("n.**"),)), 0.2)
    assert member.permission(KEY).verdict is Verdict.OPEN


def test_an_older_epoch_is_ignored():
    member = _member()
    member.assigned(_assignments(epoch=5, active="other"), 0.1)
    assert not member.assigned(_assignments(epoch=4), 0.2)
    assert member.permission(KEY).verdict is Verdict.REFUSED
    assert not member.assigned(_assignments(app_id="else", epoch=9), 0.2)


def test_after_a_pause_it_buffers_until_it_is_told_who_is_active():
    member = _member()
    member.assigned(_assignments(assignments=(_wants("n.**"),)), 0.1)
    assert member.paused(10.0)
    assert member.permission(KEY).verdict is Verdict.BUFFER
    assert [type(m) for m in member.tick(10.0)] == [Registration, Heartbeat]
    member.assigned(_assignments(epoch=2, active="other"), 10.1)
    assert member.permission(KEY).verdict is Verdict.REFUSED


def test_after_a_pause_without_a_coordinator_it_goes_on():
    member = _member()
    member.assigned(_assignments(assignments=(_wants("n.**"),)), 0.1)
    member.paused(10.0)
    member.tick(11.0)
    assert member.permission(KEY).verdict is Verdict.OPEN


def test_a_shared_or_lonely_instance_need_not_ask_after_a_pause():
    assert not _member().paused(10.0)
    shared = _member()
    shared.assigned(_assignments(active=""), 0.1)
    assert not shared.paused(10.0)


@pytest.mark.parametrize(
    "message",
    [
        _member().registration,
        _member().beat("offline", written=3),
        _assignments(
            assignments=(_wants("n.**", 2.5),), incompatible=(Incompatible(key="a.b", reason="too fast"),)
        ),
    ],
    ids=lambda m: type(m).__name__,
)
def test_messages_survive_the_wire(message):
    from due.codec import decode_value, encode_value

    assert type(message).from_value(decode_value(encode_value(message.to_value()))) == message


VALUES = {
    Registration: _member().registration.to_value(),
    Heartbeat: _member().beat().to_value(),
    Assignments: _assignments(assignments=(_wants("n.**", 2.5),)).to_value(),
}


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (Registration, "app_id", "<img src=x>"),
        (Registration, "app_id", "kitsune\n"),
        (Registration, "app_id", ""),
        (Registration, "app_id", "a" * 65),
        (Registration, "instance_id", "i'"),
        (Registration, "heartbeat", float("nan")),
        (Registration, "heartbeat", 0.0),
        (Registration, "heartbeat", 1e9),
        (Registration, "started", 2**63),
        (Registration, "revision", -1),
        (Registration, "host", "h" * 256),
        (Registration, "capabilities", [{"key": "a.b"}] * 16_385),
        (Registration, "capabilities", [{"key": "a.b", "frequency": -1.0}]),
        (Registration, "capabilities", [{"key": "a.b", "frequency": 1e-320}]),
        (Registration, "capabilities", [{"key": "a." * 1000}]),
        (Registration, "interests", [{"key": "a.b", "frequency": [1.0, float("inf")]}]),
        (Heartbeat, "epoch", 2**64 - 1),
        (Heartbeat, "epoch", 2**32 - 1),
        (Heartbeat, "epoch", -1),
        (Heartbeat, "received", 2**64 - 1),
        (Heartbeat, "app_id", "x y"),
        (Assignments, "epoch", 2**62),
        (Assignments, "active", "<b>"),
        (Assignments, "revisions", {"<b>": 1}),
        (Assignments, "assignments", [{"key": "n.**", "frequency": float("nan")}]),
        (Assignments, "assignments", [{"key": "not a key"}]),
    ],
)
def test_messages_out_of_range_are_refused_with_one_error(kind, field, value):
    kind.from_value(VALUES[kind])
    with pytest.raises(msgspec.ValidationError):
        kind.from_value({**VALUES[kind], field: value})


anything = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@given(st.sampled_from(list(VALUES)), st.data())
def test_whatever_stands_in_a_message_there_is_one_error(kind, data):
    value = dict(VALUES[kind])
    for field in data.draw(st.lists(st.sampled_from(sorted(value)), max_size=3)):
        value[field] = data.draw(anything)
    for wrong in (value, data.draw(anything)):
        with suppress(msgspec.ValidationError):
            kind.from_value(wrong)


def test_shards_of_the_apps_own_are_as_the_coordinator_says_and_unknown_after_a_suspension():
    registration = Registration(
        app_id="ctrl", instance_id="me", instances="sharded", revision=1, heartbeat=0.5, started=1
    )
    member = Member(registration, now=0.0, handshake_timeout=1.0, named=("s1", "s2"))
    assert member.named_here is None, "no Coordinator was heard yet"
    mine, other = ShardGrant("me", 3), ShardGrant("other", 3)
    member.assigned(_assignments(active="", shards={"s1": mine, "s2": other}), 0.1)
    assert (member.named_here, member.named_held) == (frozenset({"s1"}), ("s1",))
    assert member.paused(5.0)
    assert (member.named_here, member.named_held) == (None, ("s1",))
    member.assigned(_assignments(active="", version=2, shards={"s1": other, "s2": other}), 5.1)
    assert member.named_here == frozenset()


def test_without_a_coordinator_one_instance_has_all_shards_of_the_app():
    registration = Registration(
        app_id="ctrl", instance_id="me", instances="sharded", revision=1, heartbeat=0.5, started=1
    )
    member = Member(registration, now=0.0, handshake_timeout=1.0, named=("s1", "s2"))
    member.tick(1.0)
    assert member.named_here == frozenset({"s1", "s2"})
