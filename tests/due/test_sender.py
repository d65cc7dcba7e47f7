"""The sender stays away from busy writers where cores are short, and from writers that need no help."""

import math
import threading

import pytest

from due.key_writer import PUBLISH, KeyWriter
from due.keys import Key
from due.sender import Agenda, BatchSender, Pressure

PATIENCE = 30.0


def _writer(sink=lambda *_: None, dirty=lambda _: None) -> KeyWriter:
    return KeyWriter(Key("a.b"), "app", "inst", frame_bytes=1000, single_bytes=300, sink=sink, dirty=dirty)


def test_handing_over_the_interpreter_is_no_pressure():
    assert Pressure().felt(late=0.009) == 0.0


def test_pressure_is_bounded():
    assert Pressure().felt(late=60.0) <= 1.0


def test_one_visit_in_time_does_not_end_the_pressure_and_many_do():
    pressure = Pressure()
    felt = pressure.felt(late=0.03)
    assert 0 < pressure.felt(late=0.0) < felt
    assert min(pressure.felt(late=0.0) for _ in range(100)) < felt / 1000


def test_a_writer_stands_in_the_agenda_once_with_its_newest_time():
    agenda, one, other = Agenda(), _writer(), _writer()
    for due in (3.0, 5.0, 1.0):
        agenda.plan(one, due)
    agenda.plan(other, 2.0)
    assert agenda.next == 1.0
    assert agenda.take(1.5) == [(1.0, one)]
    assert agenda.take(10.0) == [(2.0, other)]
    assert agenda.next == math.inf


def test_who_comes_first_can_be_postponed_and_nobody_is_looked_for_before():
    agenda, one, other = Agenda(), _writer(), _writer()
    agenda.plan(one, 1.0)
    agenda.plan(other, 2.0)
    agenda.postpone(one, 4.0)
    assert agenda.next == 2.0
    agenda.postpone(other, 3.0)
    assert agenda.next == 3.0


def test_who_is_postponed_without_coming_first_is_not_visited_before():
    agenda, one, other = Agenda(), _writer(), _writer()
    agenda.plan(one, 1.0)
    agenda.plan(other, 2.0)
    agenda.postpone(other, 9.0)
    assert agenda.take(5.0) == [(1.0, one)]
    assert agenda.take(9.0) == [(9.0, other)]


@pytest.fixture
def visits():
    """A running sender and the batches it was asked to send."""
    done: list[list[int]] = []
    come = threading.Event()

    def sink(_writer, parts, _mode):
        done.append(parts[0][0].values)
        come.set()

    def service(writer, _now):
        writer.cut()

    sender = BatchSender(0.001, service, lambda _writer: False)
    sender.start()
    writer = _writer(sink, sender.dirty)
    writer.fast = True
    yield writer, done, come
    sender.close()


def test_what_waits_is_sent_without_the_writers_help(visits):
    writer, done, come = visits
    for n in range(3):
        come.clear()
        with writer.lock:
            writer.put(n, PUBLISH, None, n)
        assert come.wait(PATIENCE)
    assert done == [[0], [1], [2]]


def test_what_follows_full_frames_is_sent_too(visits):
    writer, done, come = visits
    for n in range(1000):
        with writer.lock:
            writer.put(n, PUBLISH, None, n)
    while sum(map(len, done)) < 1000:
        assert come.wait(PATIENCE)
        come.clear()
    assert [n for values in done for n in values] == list(range(1000))


def test_a_paced_writer_is_not_postponed_by_its_writer():
    sender = BatchSender(1000.0, lambda *_: None, lambda _: False)
    writer = _writer()
    sender.dirty(writer)
    due, writer.stay = writer.due, 1e6
    writer.pacer = object()
    sender.dirty(writer)
    assert writer.due == due
    writer.pacer = None
    sender.dirty(writer)
    assert writer.due > due
    sender.close()
