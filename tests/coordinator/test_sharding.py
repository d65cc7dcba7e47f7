"""Each shard is worked on by one instance, all instances work, and a shard moves only when it was let go."""

from collections import Counter

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from coordinator.sharding import ShardTable
from due.membership import MOST_SHARDS, Heartbeat, ShardGrant


class Instance:
    """An instance as `due` makes it: takes what it is given, and finishes what it had."""

    def __init__(self, name: str, offered: tuple[str, ...]) -> None:
        self.name = name
        self.offered = offered
        self.version = 0
        self.mine: dict[str, int] = {}
        self.held: dict[str, int] = {}

    def hear(self, version: int, given: dict[str, ShardGrant]) -> None:
        self.version = version
        self.mine = {shard: grant.number for shard, grant in given.items() if grant.instance == self.name}
        self.held |= {shard: number or self.held.get(shard, 0) for shard, number in self.mine.items()}

    def finish(self) -> None:
        self.held = {shard: number for shard, number in self.held.items() if shard in self.mine}

    def beat(self) -> Heartbeat:
        return Heartbeat(
            app_id="app",
            instance_id=self.name,
            revision=1,
            version=self.version,
            offered=self.offered,
            held=dict(self.held),
        )


class Site:
    """A table, instances that obey it, and the messages between them."""

    def __init__(self, shards: int = 6) -> None:
        self.shards = tuple(f"s{number}" for number in range(shards))
        self.table = ShardTable()
        self.version = 1
        self.unknown = False
        self.instances: dict[str, Instance] = {}
        self.beats: dict[str, Heartbeat] = {}
        self.sent: list[tuple[int, dict[str, ShardGrant], set[str]]] = []
        """Version, shards, and which instances are named: others do not follow."""
        self.read: dict[str, int] = {}
        """How many of the messages have come to an instance."""

    def join(self, name: str) -> None:
        self.instances[name] = Instance(name, self.shards)
        self.read[name] = len(self.sent)

    def settle(self) -> None:
        if self.table.settle(self.beats, self.version + 1, unknown=self.unknown):
            self.version += 1
            self.table.told(self.version)
        message = (self.version, dict(self.table.given), set(self.beats))
        if not self.sent or self.sent[-1] != message:
            self.sent.append(message)

    def tell(self, instance: Instance) -> None:
        """The next message arrives."""
        at = self.read[instance.name]
        for version, given, named in self.sent[at : at + 1]:
            self.read[instance.name] = at + 1
            if instance.name in named:
                instance.hear(version, given)

    def tell_all(self, instance: Instance) -> None:
        while self.read[instance.name] < len(self.sent):
            self.tell(instance)

    def run(self, rounds: int = 8) -> None:
        for _ in range(rounds):
            for instance in self.instances.values():
                self.tell_all(instance)
                instance.finish()
                self.beats[instance.name] = instance.beat()
            self.settle()

    def loads(self) -> list[int]:
        count = Counter(grant.instance for grant in self.table.given.values())
        return sorted(count[name] for name in self.instances)


def test_shards_are_divided_evenly_and_stay_where_they_are() -> None:
    site = Site(shards=7)
    for name in ("a", "b", "c"):
        site.join(name)
    site.run()
    assert site.loads() == [2, 2, 3]
    before = dict(site.table.given)
    site.run()
    assert site.table.given == before


def test_one_that_joins_gets_its_part_from_those_that_have_more() -> None:
    site = Site()
    site.join("a")
    site.run()
    before = dict(site.table.given)
    site.join("b")
    site.run()
    assert site.loads() == [3, 3]
    moved = [shard for shard, grant in site.table.given.items() if grant != before[shard]]
    assert len(moved) == 3
    assert all(site.table.given[shard].number > before[shard].number for shard in moved)


def test_a_shard_waits_until_the_one_that_has_it_lets_go() -> None:
    site = Site(shards=2)
    site.join("a")
    site.run()
    site.join("b")
    site.beats["b"] = site.instances["b"].beat()
    site.settle()
    (leaving,) = set(site.shards) - site.table.given.keys()
    busy = site.instances["a"]
    site.tell_all(busy)
    site.beats["a"] = busy.beat()
    site.settle()
    assert leaving not in site.table.given, "it says that it still works on it"
    busy.finish()
    site.beats["a"] = busy.beat()
    site.settle()
    assert site.table.given[leaving].instance == "b"


def test_what_a_dead_one_had_goes_to_the_others() -> None:
    site = Site()
    for name in ("a", "b", "c"):
        site.join(name)
    site.run()
    del site.instances["b"], site.beats["b"]
    site.settle()
    assert site.loads() == [3, 3]


def test_a_new_coordinator_leaves_everything_where_it_is() -> None:
    site = Site()
    for name in ("a", "b"):
        site.join(name)
    site.run()
    before = dict(site.table.given)
    site.table, site.unknown = ShardTable(), True
    site.beats = {"a": site.instances["a"].beat()}
    site.settle()
    assert {grant.instance for grant in site.table.given.values()} == {"a"}, "the other one was not heard yet"
    site.beats["b"] = site.instances["b"].beat()
    site.unknown = False
    site.settle()
    assert site.table.given == before


def test_what_nobody_offers_any_more_is_given_to_nobody() -> None:
    site = Site()
    site.join("a")
    site.run()
    site.instances["a"].offered = site.shards[:2]
    site.run()
    assert site.table.given.keys() == set(site.shards[:2])


def test_the_number_of_shards_is_bounded() -> None:
    site = Site(shards=MOST_SHARDS + 10)
    site.join("a")
    site.run()
    assert len(site.table.given) == MOST_SHARDS


class Handover(RuleBasedStateMachine):
    """Messages are late, instances come, die and dawdle, and the Coordinator is replaced."""

    names = st.sampled_from("abc")
    some = st.sets(st.sampled_from("abc"), min_size=1)
    seldom = st.integers(0, 4).map(lambda number: number == 0)

    def __init__(self) -> None:
        super().__init__()
        self.site = Site(shards=3)
        for name in ("a", "b"):
            self.site.join(name)

    def _living(self, names: set[str]) -> list[Instance]:
        return [one for name, one in self.site.instances.items() if name in names]

    @rule(name=names)
    def joins(self, name: str) -> None:
        if name not in self.site.instances:
            self.site.beats.pop(
                name, None
            )  # a new process: the Coordinator has noticed that the old one ended
            self.site.join(name)

    @rule(name=names, really=seldom)
    def dies(self, name: str, really: bool) -> None:
        if really:
            self.site.instances.pop(name, None)

    @rule(name=names)
    def death_is_noticed(self, name: str) -> None:
        if name not in self.site.instances:
            self.site.beats.pop(name, None)

    @rule(names=some)
    def hear(self, names: set[str]) -> None:
        for one in self._living(names):
            self.site.tell(one)

    @rule(names=some)
    def finish(self, names: set[str]) -> None:
        for one in self._living(names):
            one.finish()

    @rule(names=some)
    def beat(self, names: set[str]) -> None:
        for one in self._living(names):
            self.site.beats[one.name] = one.beat()

    @rule()
    def settles(self) -> None:
        self.site.unknown = self.site.unknown and not self.site.instances.keys() <= self.site.beats.keys()
        self.site.settle()

    @rule(really=seldom)
    def coordinator_is_replaced(self, really: bool) -> None:
        if really:
            self.site.table, self.site.beats = ShardTable(), {}
            self.site.version += 100
            self.site.unknown = True

    @precondition(lambda self: self.site.instances)
    @rule()
    def comes_to_rest(self) -> None:
        self.site.beats = {
            name: self.site.beats[name] for name in self.site.instances if name in self.site.beats
        }
        self.site.unknown = False
        self.site.run(12)
        assert self.site.table.given.keys() == set(self.site.shards)
        assert self.site.loads()[-1] - self.site.loads()[0] <= 1

    @invariant()
    def no_shard_is_held_twice(self) -> None:
        held = Counter(shard for one in self.site.instances.values() for shard in one.held)
        assert not [shard for shard, count in held.items() if count > 1]


Handover.TestCase.settings = settings(max_examples=200, stateful_step_count=50, deadline=None)
test_nothing_is_held_twice_whatever_happens = Handover.TestCase
