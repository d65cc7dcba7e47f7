"""Shards that an app names itself: each has one instance, and every instance hears everything."""

import pytest

from due import Capability
from due.errors import InvalidOption
from tests.due.conftest import wait_for

NAMES = ("north", "east", "south", "west")
ORDERS = Capability("t.order.*", delivery="reliable")


def test_names_belong_to_sharded_apps_and_are_there_once(make_engine) -> None:
    for init, words in (
        ({"shards": NAMES}, "instances"),
        ({"instances": "sharded", "shards": ("a", "a")}, "each once"),
        ({"instances": "sharded", "shards": ("",)}, "1 to 255"),
    ):
        with pytest.raises(InvalidOption, match=words):
            make_engine("namer", init=init)
    engine = make_engine("namer", init={"instances": "sharded", "shards": NAMES})
    with pytest.raises(InvalidOption, match="was given"):
        engine.offer_shards(["up"])


def test_without_a_coordinator_one_has_all_of_them(make_engine) -> None:
    engine = make_engine("alone", init={"instances": "sharded", "shards": NAMES})
    wait_for(lambda: engine.shards() == frozenset(NAMES))


@pytest.fixture
def url(request):
    """Of Data Updates; made first, so that it ends last."""
    return request.getfixturevalue(request.param).url


@pytest.mark.parametrize("url", ["own_server", "kafka_server"], indirect=True)
def test_the_instances_divide_them_and_each_hears_everything(url, make_engine, programs, tmp_path) -> None:
    archive = f"sqlite://{tmp_path / 'coordinator.db'}"
    programs("--updates", url, "--archive", archive, module="coordinator.service").wait_for('{"ready"')

    def member():
        engine = make_engine(
            "keeper", url=url, coordinated=True, heartbeat=0.1, init={"instances": "sharded", "shards": NAMES}
        )
        got: list[int] = []
        engine.observe("t.order.*").subscribe(lambda item: got.append(item.value))
        return engine, got

    source = make_engine("source", url=url, coordinated=True, init={"capabilities": [ORDERS]})
    members = [member(), member()]

    def divided() -> bool:
        found = [engine.shards() for engine, _ in members]
        return all(found) and sorted(len(one) for one in found) == [2, 2] and not found[0] & found[1]

    wait_for(divided)
    wait_for(lambda: source.wanted("t.order.x"))
    for number in range(100):
        source.write("t.order.x", number)
    for _, got in members:
        wait_for(lambda heard=got: len(heard) == 100)
        assert got == list(range(100))
    members[1][0].offer_shards(NAMES[:1])
    wait_for(lambda: members[0][0].shards() == frozenset(NAMES[1:]))
    wait_for(lambda: members[1][0].shards() == frozenset(NAMES[:1]))
    members[1][0].offer_shards(NAMES)
    wait_for(divided)
    members[0][0].close()
    wait_for(lambda: members[1][0].shards() == frozenset(NAMES))
    source.write("t.order.y", 100)
    source.flush()
    wait_for(lambda: members[1][1][-1] == 100)
