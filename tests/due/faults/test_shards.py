"""A sharded app under a real Coordinator: every item counts once and in order, whoever is killed or stopped."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from due import PRODUCER, PUB_ONLY, Capability, Engine, Options
from due.shard_archive import ArchivedStates
from tests.due.conftest import wait_for
from tests.due.faults.programs import CHAINS, LINKS, linked

PATHS = tuple(f"{LINKS}.p{number}" for number in range(6))


class Load:
    """Writes numbers under all paths, and knows what their chains must be."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._write)
        self.numbers = 0
        self.chain = 0

    def _write(self) -> None:
        while not self._stop.wait(0.002):
            for path in PATHS:
                self._engine.write(path, self.numbers, [PUB_ONLY])
            self.chain = linked(self.chain, self.numbers)
            self.numbers += 1

    def __enter__(self) -> "Load":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def more(self, numbers: int = 300) -> None:
        """Return when so many more are written."""
        enough = self.numbers + numbers
        wait_for(lambda: self.numbers >= enough)


@contextmanager
def engine_at(url: str, folder: Path) -> Iterator[Engine]:
    engine = Engine(
        Options(coordinated=False, directory=str(folder), archive=f"sqlite:///{folder}/archive.db")
    )
    engine.set_pubsub(url)
    engine.init("maker", PRODUCER, capabilities=[Capability(f"{LINKS}.*", delivery="reliable")])
    try:
        yield engine
    finally:
        engine.close()


@pytest.fixture
def site(programs, own_server, tmp_path) -> Iterator[tuple[Callable[[], object], Load, ArchivedStates]]:
    """Starts members; the load; the states in the archive."""

    def member():
        program = programs("chain", own_server.url, tmp_path)
        program.wait_for("ready")
        return program

    with engine_at(own_server.url, tmp_path) as engine:
        yield member, Load(engine), ArchivedStates(engine, CHAINS)


def _paths_of(member) -> set[str]:
    return {line.split()[1] for line in member.lines() if line.startswith("loaded")}


def _ends(states: ArchivedStates, load: Load) -> None:
    """Return when every chain is what it must be."""
    wanted = [load.numbers, load.chain]

    def found() -> list[list[int]]:
        return [list(saved[0]) if (saved := states.load(path)) else [] for path in PATHS]

    deadline = time.monotonic() + 80
    while (chains := found()) != [wanted] * len(PATHS):
        assert all(not chain or chain[0] <= load.numbers for chain in chains), "an item counted twice"
        assert time.monotonic() < deadline, f"{chains} of {wanted}"
        time.sleep(0.1)


def test_all_members_work_and_one_that_joins_gets_paths_with_their_state(site, coordinator) -> None:
    member, load, states = site
    coordinator()
    first = member()
    with load:
        wait_for(lambda: _paths_of(first) == set(PATHS))
        load.more()
        second = member()
        wait_for(lambda: len(_paths_of(second)) == 3)
        load.more()
    _ends(states, load)
    assert all(int(line.split()[2]) for line in second.lines() if line.startswith("loaded"))


def test_after_a_kill_the_others_go_on_from_what_was_saved(site, coordinator) -> None:
    member, load, states = site
    coordinator()
    members = [member() for _ in range(3)]
    with load:
        wait_for(lambda: all(map(_paths_of, members)))
        load.more()
        members[0].kill()
        load.more()
        members.append(member())
        load.more()
        members[1].kill()
        load.more()
    _ends(states, load)


def test_a_member_that_was_stopped_for_long_spoils_nothing(site, coordinator) -> None:
    member, load, states = site
    coordinator()
    members = [member() for _ in range(2)]
    with load:
        wait_for(lambda: all(map(_paths_of, members)))
        load.more()
        members[0].stop(signal.SIGSTOP)
        wait_for(lambda: _paths_of(members[1]) == set(PATHS))
        load.more()
        members[0].stop(signal.SIGCONT)
        load.more()
    _ends(states, load)


def test_a_coordinator_that_is_killed_and_comes_back_moves_no_path(site, coordinator) -> None:
    member, load, states = site
    first = coordinator()
    members = [member() for _ in range(2)]
    with load:
        wait_for(lambda: all(len(_paths_of(one)) >= 3 for one in members))
        load.more()
        before = [one.lines() for one in members]
        first.kill()
        load.more()
        coordinator()
        load.more(1000)
        assert [one.lines() for one in members] == before
    _ends(states, load)


def test_without_a_coordinator_one_member_works_on_everything(site, coordinator) -> None:
    member, load, states = site
    members = [member() for _ in range(2)]
    with load:
        wait_for(lambda: any(_paths_of(one) == set(PATHS) for one in members))
        load.more()
        coordinator()
        wait_for(lambda: all(map(_paths_of, members)))
        load.more()
    _ends(states, load)
