"""A thread that dies is told: in a library by every later call, in a service by the end of the process."""

import sys
import threading
from contextlib import suppress

import pytest

from due import CONSUMER, NO_WAIT, PRODUCER, Capability
from due.errors import EngineFailed, UnsupportedValue
from tests.due.conftest import wait_for

THREADS = ("due-dispatcher", "due-heartbeat", "due-sender", "due-archiver")


def _kill(engine, name, monkeypatch):
    """Let the thread run into a defect."""
    session = engine._session
    part, method = {
        "due-dispatcher": (session.dispatcher.receiver, "receive"),
        "due-heartbeat": (session.heartbeats.member, "tick"),
        "due-sender": (session.sender, "_visit"),
        "due-archiver": (session._archiver, "_insert"),
    }[name]

    def broken(*_arguments, **_options):
        raise RuntimeError("a defect")

    monkeypatch.setattr(part, method, broken)
    session.dispatcher.receiver.wake()
    with suppress(EngineFailed):  # it may have run into it already
        engine.write("dead.thread", 1)


@pytest.mark.parametrize("name", THREADS)
def test_every_later_call_says_that_the_engine_failed(make_engine, monkeypatch, caplog, name):
    engine = make_engine("notebook")
    engine.write("dead.thread", 0)
    engine.flush()
    _kill(engine, name, monkeypatch)
    wait_for(lambda: engine.failed is not None)
    assert str(engine.failed) == "a defect"
    for call in (
        lambda: engine.write("dead.thread", 2),
        lambda: engine.observe("dead.**"),
        engine.flush,
        engine.health,
        lambda: engine.get("dead.thread"),
    ):
        with pytest.raises(EngineFailed, match="RuntimeError: a defect"):
            call()
    assert name in caplog.text
    assert "Traceback" in caplog.text
    engine.close()
    engine.init("notebook", PRODUCER | CONSUMER)
    assert engine.failed is None
    assert engine.write("dead.thread", 3)


def test_a_callback_that_ends_its_thread_ends_the_engine(make_engine):
    engine = make_engine("exits")
    engine.observe("dead.exit").subscribe(lambda _item: sys.exit(0))
    engine.write("dead.exit", 1, [NO_WAIT])
    wait_for(lambda: isinstance(engine.failed, SystemExit))


def test_what_a_dead_engine_has_not_handled_stays_in_the_stream(make_engine, monkeypatch):
    init = {"capabilities": [Capability("dead.kept", delivery="reliable")]}
    producer = make_engine("keeps", init=init)
    consumer = make_engine("dies")
    dead, go_on, seen = threading.Event(), threading.Event(), []

    def handle(item):
        dead.set()
        go_on.wait(60)
        consumer.write("dead.result", item.value)
        seen.append(item.value)

    consumer.observe("dead.kept").subscribe(handle)
    producer.write("dead.kept", 1, [NO_WAIT])
    assert dead.wait(60)
    _kill(consumer, "due-heartbeat", monkeypatch)
    wait_for(lambda: consumer.failed is not None)
    go_on.set()
    consumer.close()
    monkeypatch.undo()
    successor, got = make_engine("dies"), []
    successor.observe("dead.kept").subscribe(lambda item: got.append(item.value))
    wait_for(lambda: got == [1])
    assert not seen


def test_an_event_time_beyond_64_bits_is_refused_at_the_writer(make_engine):
    engine = make_engine("late")
    with pytest.raises(UnsupportedValue, match="event time"):
        engine.write("dead.time", 1, event_time=2**63)
    engine.write("dead.time", 2, event_time=2**63 - 1)
    engine.flush()
    assert [item.value for item in engine.get("dead.time")] == [2]
