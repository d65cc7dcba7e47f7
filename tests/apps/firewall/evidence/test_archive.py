"""A decision never waits for an archive that is away, and asks again when it may be back."""

import threading

from apps.firewall.evidence.archive import Archive
from due import Item
from tests.apps.firewall.desk import FakeEngine


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
    engine.archived.append(Item("a.b.c", 1, 1, 1, "a", "i", 1))
    archive = Archive(engine, 60.0)  # type: ignore[arg-type]
    assert archive.look({"dataKey": "a.b.c"}, 0, 1e6) == archive.look({"dataKey": "a.b.c"}, 0, 1e6) == []
    engine.archive_hangs.set()
    archive._looking.join(60)
    assert archive.look({"dataKey": "a.b.c"}, 0, 1e6) == engine.archived
    assert archive.look({"dataKey": "a.b.c"}, 0, 1e6) == []
    assert archive._looking is None


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
