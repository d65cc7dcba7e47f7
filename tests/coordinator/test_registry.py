"""The registry keeps one working instance per app, tells every app what is wanted, and forgets nothing that lives."""

from collections.abc import Sequence
from typing import Any

import pytest

from coordinator.registry import InstanceState, Registry
from coordinator.selection import STRATEGIES, Candidate
from due.membership import Assignments, Heartbeat, Registration
from due.messages import Capability, Interest


class World:
    """A registry, and instances that answer it as `due.membership.Member` does."""

    def __init__(self, **options: Any) -> None:
        options.setdefault("select", first)
        self.registry = Registry("c1", **options)
        self.registry.activate()
        self.now = 100.0
        self.told: dict[str, Assignments] = {}

    def join(self, app: str, name: str, revision: int = 1, **fields: Any) -> None:
        fields = {"heartbeat": 0.1, "started": int(name.strip("abcdefghijklmnopqrstuvwxyz") or 0)} | fields
        self.registry.registered(
            Registration(app_id=app, instance_id=name, revision=revision, **fields), self.now
        )
        self.send()

    def beat(self, app: str, name: str, **fields: Any) -> None:
        told = self.told.get(app)
        if told is not None:
            fields = {"version": told.version, "epoch": told.epoch, "active": told.active == name} | fields
        self.registry.beat(Heartbeat(app_id=app, instance_id=name, **({"revision": 1} | fields)), self.now)
        self.registry.expire(self.now)
        self.send()

    def run(self, seconds: float, alive: Sequence[tuple[str, str]]) -> None:
        for _ in range(round(seconds * 10)):
            self.now += 0.1
            for app, name in alive:
                self.beat(app, name)
            self.registry.expire(self.now)
            self.send()

    def send(self) -> list[Assignments]:
        sent = self.registry.outgoing()
        self.told |= {message.app_id: message for message in sent}
        return sent

    def wanted(self, app: str) -> list[str]:
        return [assignment.key for assignment in self.told[app].assignments]

    def states(self) -> dict[str, str]:
        return {one.registration.instance_id: state.value for one, state in self.registry.instances()}


def first(candidates: Sequence[Candidate]) -> Candidate:
    """The first in the order of instance ids."""
    return candidates[0]


def test_joining_is_answered_with_what_is_wanted() -> None:
    world = World()
    world.join("p", "p1", capabilities=(Capability("a.b", 10.0),))
    assert world.wanted("p") == []
    assert world.told["p"].active == "p1"
    assert world.told["p"].revisions == {"p1": 1}
    world.join("c", "c1", interests=(Interest("a.*", 5.0),))
    (assignment,) = world.told["p"].assignments
    assert (assignment.key, assignment.frequency, assignment.epoch) == ("a.*", 5.0, world.told["p"].epoch)


def test_leaving_withdraws_what_was_wanted() -> None:
    world = World()
    world.join("p", "p1", capabilities=(Capability("a.b"),))
    world.join("c", "c1", interests=(Interest("a.b"),))
    world.beat("c", "c1", state="offline")
    assert world.wanted("p") == []
    assert world.states() == {"p1": "active", "c1": "offline"}


def test_a_changed_declaration_is_matched_anew() -> None:
    world = World()
    world.join("p", "p1", capabilities=(Capability("a.b"), Capability("x")))
    world.join("c", "c1", interests=(Interest("a.b"),))
    world.join("c", "c1", revision=2, interests=(Interest("x"),))
    assert world.wanted("p") == ["x"]
    assert world.told["c"].revisions == {"c1": 2}


def test_the_choice_sticks_until_its_instance_is_gone() -> None:
    world = World()
    for name in ("i2", "i1", "i3"):
        world.join("app", name)
    chosen = world.told["app"].active
    assert chosen == "i2"
    world.run(2.0, [("app", name) for name in ("i1", "i2", "i3")])
    assert world.told["app"].active == "i2"
    epoch = world.told["app"].epoch
    world.run(1.0, [("app", name) for name in ("i1", "i3")])
    assert world.told["app"].active == "i1"
    assert world.told["app"].epoch > epoch
    assert world.states() == {"i2": "unresponsive", "i1": "active", "i3": "idle"}
    world.run(1.0, [("app", name) for name in ("i1", "i2", "i3")])
    assert world.told["app"].active == "i1", "the former one comes back and waits"
    assert world.states()["i2"] == "idle"
    assert world.registry.failovers == 1


def test_failover_takes_less_than_a_second_at_ten_heartbeats_a_second() -> None:
    world = World()
    world.join("app", "i1")
    world.join("app", "i2")
    world.run(1.0, [("app", "i1"), ("app", "i2")])
    world.run(0.9, [("app", "i2")])
    assert world.told["app"].active == "i2"


def test_good_bye_fails_over_at_once() -> None:
    world = World()
    world.join("app", "i1")
    world.join("app", "i2")
    world.beat("app", "i1", state="offline")
    assert world.told["app"].active == "i2"


def test_shared_instances_all_work() -> None:
    world = World()
    world.join("app", "i1", instances="shared")
    world.join("app", "i2", instances="shared")
    assert world.told["app"].active == ""
    assert set(world.states().values()) == {"active"}


def test_paths_of_a_sharded_app_go_to_its_living_instances_only() -> None:
    world = World()
    world.run(1.0, [])
    for name in ("i1", "i2"):
        world.join("app", name, instances="sharded")
    for _ in range(3):
        for name in ("i1", "i2"):
            told = world.told["app"].shards
            mine = {shard: grant.number for shard, grant in told.items() if grant.instance == name}
            world.beat("app", name, active=True, offered=("a.b", "a.c"), held=mine)
    assert world.told["app"].active == ""
    assert {grant.instance for grant in world.told["app"].shards.values()} == {"i1", "i2"}
    for _ in range(10):
        world.now += 0.1
        world.beat("app", "i2", active=True, offered=("a.b", "a.c"))
    assert {grant.instance for grant in world.told["app"].shards.values()} == {"i2"}
    assert set(world.told["app"].shards) == {"a.b", "a.c"}


def test_every_epoch_is_above_the_last() -> None:
    world = World()
    epochs = []
    for n in range(1, 6):
        world.join("app", f"i{n}")
        epochs.append(world.told["app"].epoch)
        world.beat("app", f"i{n}", state="offline")
    assert epochs == sorted(set(epochs))


def test_an_instance_that_knows_a_later_epoch_is_told_in_that_epoch() -> None:
    world = World()
    world.join("app", "i1")
    world.beat("app", "i1", epoch=5000)
    assert world.told["app"].epoch >= 5000
    version = world.told["app"].version
    world.beat("app", "i1")
    assert world.told["app"].version == version


def test_an_unknown_instance_is_asked_to_register() -> None:
    world = World()
    world.beat("app", "i9", version=7, epoch=12)
    message = world.told["app"]
    assert "i9" not in message.revisions
    assert message.epoch == 12, "an instance ignores what is older than it knows"


def test_an_old_revision_or_version_is_told_again() -> None:
    world = World()
    world.join("app", "i1", revision=2)
    assert world.registry.outgoing() == []
    version = world.told["app"].version
    for wrong in ({"revision": 1, "version": version}, {"revision": 2, "version": 999}):
        beat = Heartbeat(app_id="app", instance_id="i1", revision=wrong["revision"], version=wrong["version"])
        world.registry.beat(beat, world.now)
        assert [m.app_id for m in world.registry.outgoing()] == ["app"]
    world.beat("app", "i1", revision=2)
    assert world.registry.outgoing() == []


@pytest.mark.parametrize("order", [("i1", "i2"), ("i2", "i1")])
def test_a_new_coordinator_keeps_who_works(order: tuple[str, str]) -> None:
    old = World()
    old.join("app", "i1", interests=(Interest("a"),))
    old.join("app", "i2", interests=(Interest("a"),))
    old.beat("app", "i1", state="offline")
    old.join("app", "i1")
    told = old.told["app"]
    assert told.active == "i2"

    new = World(version=1000)
    new.registry.stand_by()
    for name in order:
        new.beat("app", name, version=told.version, epoch=told.epoch, active=name == "i2")
        assert name not in new.told["app"].revisions
        new.join("app", name)
        new.beat("app", name, version=told.version, epoch=told.epoch, active=name == "i2")
    new.registry.activate()
    new.send()
    assert new.told["app"].active == "i2"
    assert new.told["app"].epoch > told.epoch
    assert set(new.told["app"].revisions) == {"i1", "i2"}


def test_a_new_coordinator_keeps_the_instance_that_worked_alone() -> None:
    """Of standbys that never heard of a Coordinator one works; the others wait."""
    world = World()
    world.registry.stand_by()
    for name in ("m1", "m2"):
        world.join("m", name)
        world.beat("m", name, version=0, epoch=0, active=name == "m2")
    world.registry.activate()
    world.send()
    assert world.told["m"].active == "m2"


def test_who_follows_listens_and_gives_no_orders() -> None:
    world = World()
    world.registry.stand_by()
    world.beat("p", "p1")
    assert world.told.pop("p").revisions == {}, "it asks who that is"
    world.join("p", "p1", capabilities=(Capability("a"),))
    world.beat("p", "p1")
    assert world.told == {}
    world.registry.activate()
    world.send()
    assert world.told["p"].active == "p1"


def test_a_silence_of_all_is_nobodys_fault() -> None:
    world = World()
    for app in ("one", "two"):
        world.join(app, f"{app}1")
        world.join(app, f"{app}2")
    everyone = [("one", "one1"), ("one", "one2"), ("two", "two1"), ("two", "two2")]
    world.run(1.0, everyone)
    before = {app: told.active for app, told in world.told.items()}
    world.run(10.0, [])
    world.beat("one", "one2")
    world.run(1.0, everyone)
    assert {app: told.active for app, told in world.told.items()} == before
    assert world.registry.failovers == 0


def test_a_coordinator_that_was_stopped_blames_nobody() -> None:
    world = World()
    world.join("app", "i1")
    world.join("app", "i2")
    world.run(1.0, [("app", "i1"), ("app", "i2")])
    world.now += 30
    world.registry.expire(world.now)
    assert set(world.states().values()) == {"active", "idle"}


def test_who_is_heard_after_a_stop_is_not_trusted_for_longer_than_others() -> None:
    world = World()
    world.join("a", "a1")
    world.now += 60
    world.registry.beat(Heartbeat(app_id="a", instance_id="a1", revision=1), world.now)
    world.registry.expire(world.now)
    world.run(2.0, [])
    assert world.states() == {"a1": "unresponsive"}


def test_who_is_active_again_keeps_an_active_instance_that_asks_whether_it_still_is() -> None:
    world = World()
    world.join("a", "a2")
    world.join("a", "a1")
    world.registry.stand_by()
    world.beat("a", "a1", active=False)
    world.beat("a", "a2", active=False)
    world.registry.activate()
    assert {each.active for each in world.send()} == {"a2"}


def test_who_is_active_again_does_not_bring_back_an_instance_that_was_replaced() -> None:
    """After a silence of all the dead are not known to be dead, and what they said last is old."""
    world = World()
    world.join("a", "a1")
    world.join("a", "a2")
    world.beat("a", "a1")
    world.run(0.6, [("a", "a2")])
    assert world.told["a"].active == "a2"
    world.registry.stand_by()
    world.now += 1.0
    world.beat("a", "a2", active=False)
    world.registry.activate()
    world.send()
    assert world.told["a"].active == "a2"


def test_the_only_instance_keeps_its_place_over_an_outage() -> None:
    world = World()
    world.join("app", "i1", interests=(Interest("a"),))
    world.join("p", "p1", capabilities=(Capability("a"),))
    epoch = world.told["app"].epoch
    world.run(2.0, [("p", "p1")])
    assert world.states()["i1"] == "unresponsive"
    assert world.wanted("p") == []
    world.beat("app", "i1")
    world.send()
    assert world.states()["i1"] == "active"
    assert world.told["app"].epoch == epoch
    assert world.wanted("p") == ["a"]


def test_who_is_gone_for_long_is_forgotten_but_its_epoch_is_not() -> None:
    world = World(forget_s=5.0)
    world.join("app", "i1")
    world.join("other", "o1")
    epoch = world.told["app"].epoch
    world.run(10.0, [("other", "o1")])
    assert "i1" not in world.states()
    assert world.registry.epochs()["app"] == epoch
    world.join("app", "i2")
    assert world.told["app"].epoch > epoch


def test_events_tell_the_story_once() -> None:
    world = World()
    world.join("p", "p1", capabilities=(Capability("a", 1.0),))
    world.join("c", "c1", interests=(Interest("a", 9.0),))
    world.beat("c", "c1")
    world.beat("p", "p1", state="offline")
    kinds = [(event.kind, event.app_id) for event in world.registry.events()]
    assert kinds == [
        ("joined", "p"),
        ("activated", "p"),
        ("joined", "c"),
        ("activated", "c"),
        ("incompatible", "c"),
        ("offline", "p"),
    ]
    assert world.registry.events() == []


@pytest.mark.parametrize("name", sorted(STRATEGIES))
def test_every_strategy_picks_one_of_the_candidates(name: str) -> None:
    world = World(select=STRATEGIES[name])
    world.join("app", "i2")
    world.join("app", "i1")
    assert world.told["app"].active in ("i1", "i2")
    candidates = [(one.registration, one.beat) for one, _ in world.registry.instances()]
    assert STRATEGIES[name](candidates) in candidates


def test_states_are_the_four_of_the_design() -> None:
    assert [state.value for state in InstanceState] == ["active", "idle", "unresponsive", "offline"]


def _left_by_a_former_coordinator() -> World:
    old = World()
    old.join("app", "a1")
    old.join("app", "b2")
    old.run(1.0, [("app", "a1"), ("app", "b2")])
    old.run(1.0, [("app", "b2")])
    assert old.told["app"].active == "b2"
    return old


def test_a_checkpoint_spares_the_question_and_keeps_who_worked() -> None:
    old = _left_by_a_former_coordinator()
    old.join("app", "a1")
    new = World()
    new.registry.recall(old.registry.checkpoint())
    assert new.states() == {}, "remembered is not alive"
    new.now = old.now
    fields = {"version": old.told["app"].version, "epoch": old.told["app"].epoch}
    # the first sign of life comes from the one that waits, and alone it would be chosen
    new.registry.beat(Heartbeat(app_id="app", instance_id="a1", revision=1, **fields), new.now)
    new.registry.beat(Heartbeat(app_id="app", instance_id="b2", revision=1, **fields), new.now)
    new.send()
    assert new.told["app"].active == "b2"
    assert set(new.told["app"].revisions) == {"a1", "b2"}
    assert new.told["app"].epoch > old.told["app"].epoch
    assert [event.kind for event in new.registry.events()] == ["activated"], "nobody joined"


def test_a_checkpoint_of_another_revision_is_not_trusted_and_epochs_never_fall() -> None:
    old = _left_by_a_former_coordinator()
    new = World()
    new.registry.recall(old.registry.checkpoint())
    new.registry.beat(Heartbeat(app_id="app", instance_id="b2", revision=2), new.now)
    asked = new.send()
    assert [message.revisions for message in asked] == [{}]
    assert new.states() == {}
    new.join("app", "c3")
    assert new.told["app"].epoch > old.told["app"].epoch
