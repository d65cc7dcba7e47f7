"""A decision never waits for an archive that is away, and asks again when it may be back."""

import threading
import time
import types

import pytest

from apps.firewall.evidence.archive import Archive
from due import Item
from tests.apps.firewall.desk import FakeEngine

_HOUR = 3600 * 10**9
_QUERY = {"dataKey": "a.b.c"}


@pytest.fixture
def clock(monkeypatch):
    """The wall clock of the archive's questions: set `now`, ns."""
    made = types.SimpleNamespace(now=10**18, monotonic=time.monotonic)
    made.time_ns = lambda: made.now
    monkeypatch.setattr("apps.firewall.evidence.archive.time", made)
    return made


def test_answers():
    """Items as the engine finds them."""
    assert Archive(FakeEngine(), 60.0).find("a.b.c") == []  # type: ignore[arg-type]


def test_away_is_remembered_for_a_while(monkeypatch):
    """The second question is not even asked; later ones are."""
    engine = FakeEngine()
    archive = Archive(engine, 60.0)  # type: ignore[arg-type]
    engine.archive_away = True
    assert archive.find("a.b.c") is None
    engine.archive_away = False
    assert archive.away
    assert archive.find("a.b.c") is None
    assert archive.unanswered == 2
    monkeypatch.setattr(archive, "_quiet_until", 0.0)
    assert archive.find("a.b.c") == []


def test_looking_never_waits():
    """The answer comes with a later look, and the next question after a while."""
    engine = FakeEngine()
    engine.archive_hangs = threading.Event()
    at = time.time_ns()
    engine.archived.append(Item("a.b.c", 1, at, at, "a", "i", 1))
    archive = Archive(engine, 60.0)  # type: ignore[arg-type]
    assert archive.look(_QUERY, _HOUR, 1e6) == archive.look(_QUERY, _HOUR, 1e6) == []
    engine.archive_hangs.set()
    archive._looking.join(60)
    assert archive.look(_QUERY, _HOUR, 1e6) == engine.archived
    assert archive.look(_QUERY, _HOUR, 1e6) == []
    assert archive._looking is None


def _looked(archive: Archive) -> list[Item]:
    assert archive.look(_QUERY, _HOUR, 0.0) == []
    archive._looking.join(60)
    return archive.look(_QUERY, _HOUR, 0.0)


def test_a_look_reads_what_is_new_and_not_all_since_the_start(clock):
    """An operator's program gives an instruction every few seconds, and all of them were read every two seconds."""
    engine = FakeEngine()
    archive = Archive(engine, 60.0)  # type: ignore[arg-type]
    found = []
    for number in range(1, 61):
        clock.now += _HOUR // 6
        engine.archived.append(Item("a.b.c", number, clock.now, clock.now, "a", "i", number))
        found.append(len(_looked(archive)))
    assert found[-1] == max(found) == 7


def test_a_look_finds_what_came_while_the_archive_was_away(clock):
    engine = FakeEngine()
    archive = Archive(engine, 60.0)  # type: ignore[arg-type]
    engine.archive_away = True
    for _ in range(3):
        clock.now += 3 * _HOUR
        assert _looked(archive) == []
    engine.archived.append(Item("a.b.c", 1, 10**18 + _HOUR, 0, "a", "i", 1))
    engine.archive_away = False
    assert _looked(archive) == engine.archived
    clock.now = 10**18 + _HOUR
    assert _looked(archive) == engine.archived, "a clock that was ahead and is set back hides nothing"


def test_hanging_question_is_left_behind(monkeypatch):
    """No second one is asked while it hangs."""
    engine = FakeEngine()
    engine.archive_hangs = threading.Event()
    archive = Archive(engine, 0.05)  # type: ignore[arg-type]
    assert archive.find("a.b.c") is None
    monkeypatch.setattr(archive, "_quiet_until", 0.0)
    assert archive.find("a.b.c") is None
    engine.archive_hangs.set()
    archive._asked.join(60)
    assert archive.find("a.b.c", 60.0) == []
