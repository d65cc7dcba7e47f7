"""States of shards: of several the one that counts is found, and what is no place is none."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from due import DB_ONLY, Capability
from due.errors import ArchiveUnavailable, InvalidOption
from due.shard_archive import ArchivedStates
from due.shards import Place, grant_of
from tests.due.conftest import wait_for

ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text() | st.sampled_from(["number", "next"]), inner),
    max_leaves=10,
)


class Nothing:
    """A state that is never asked for."""

    def load(self, path: str) -> Place | None:
        raise AssertionError(path)

    def save(self, path: str, place: Place) -> None:
        raise AssertionError(path, place)

    def drop(self, path: str) -> None:
        raise AssertionError(path)


def _place(number: int) -> Place:
    return {"number": number, "next": [["i", "a.b", 3]]}


@given(value=ANYTHING)
def test_what_is_no_place_has_no_grant(value: Any) -> None:
    assert grant_of(value) == -1 or isinstance(value, dict)


@pytest.mark.parametrize("number", [-1, 1 << 62])
def test_numbers_out_of_range_are_no_place(number: int) -> None:
    assert grant_of(_place(1)) == 1
    assert grant_of(_place(number)) == -1
    assert grant_of({"number": 1, "next": [["i", "a.b", number]]}) == -1


def test_the_state_of_the_last_grant_is_loaded_even_if_an_older_one_was_written_later(make_engine) -> None:
    engine = make_engine("keeper")
    states = ArchivedStates(engine, "t.state.keeper")
    assert states.load("a.b") is None
    states.save("a.b", "first", _place(1))
    states.save("a.b", "successor", _place(2))
    states.save("a.b", "late", _place(1))
    engine.write("t.state.keeper.a.b", "of somebody else", [DB_ONLY])
    assert states.load("a.b") == ("successor", _place(2))
    assert states.load("a.c") is None


@pytest.mark.parametrize("spool_bytes", [1 << 20, 1])
def test_a_state_is_saved_when_the_archive_has_it(make_engine, tmp_path: Path, spool_bytes: int) -> None:
    """A successor on another host finds none in this one's spool; and attempts to save it do not fill that."""
    folder = tmp_path / "archive"
    folder.write_text("no folder")
    engine = make_engine("spooler", archive=f"sqlite://{folder / 'a.db'}", spool_bytes=spool_bytes)
    states = ArchivedStates(engine, "t.state.spooler")
    for number in range(3):
        with pytest.raises(ArchiveUnavailable):
            states.save("a.b", number, _place(number))
    assert engine.health()["archive"]["spooled"] == (spool_bytes > 1)
    folder.unlink()

    def saved() -> bool:
        with suppress(ArchiveUnavailable):
            states.save("a.b", "last", _place(3))
            return True
        return False

    wait_for(saved)
    assert states.load("a.b") == ("last", _place(3))


def test_state_is_kept_by_sharded_apps_only_and_from_the_beginning(make_engine) -> None:
    with pytest.raises(InvalidOption, match="sharded"):
        make_engine("standby").keep_state(Nothing())
    engine = make_engine("late", init={"instances": "sharded"})
    with pytest.raises(InvalidOption, match="greater than 0"):
        engine.keep_state(Nothing(), every=0)
    engine.observe("t.late").subscribe(print)
    with pytest.raises(InvalidOption, match="before the first subscription"):
        engine.keep_state(Nothing())


def test_a_sharded_app_without_state_gets_every_item_in_order(make_engine) -> None:
    engine = make_engine(
        "stateless",
        init={"instances": "sharded", "capabilities": [Capability("t.plain.*", delivery="reliable")]},
    )
    got: list[int] = []
    engine.observe("t.plain.*").subscribe(lambda item: got.append(item.value))
    for number in range(200):
        engine.write("t.plain.x", number)
    wait_for(lambda: len(got) == 200)
    assert got == list(range(200))
    wait_for(lambda: engine.health()["updates"]["kept_bytes"] == 0)
