"""Health is a round trip: it says which thread does not answer, and tells a long callback from a hung thread."""

import threading

from due import NO_WAIT, PUB_ONLY
from due import liveness as module
from tests.due.conftest import wait_for


def _blocked(engine):
    """A callback that runs until the event is set."""
    inside, go_on = threading.Event(), threading.Event()

    def handle(_item):
        inside.set()
        go_on.wait(60)

    engine.observe("live.block").subscribe(handle)
    engine.write("live.block", 1, [PUB_ONLY, NO_WAIT])
    assert inside.wait(60)
    return go_on


def test_an_idle_engine_answers(make_engine):
    liveness = make_engine("idle").liveness
    for _ in range(3):
        wait_for(liveness.beat)
    assert liveness.state()["status"] == "ok"


def test_a_long_callback_is_busy_and_at_last_stalled(make_engine, monkeypatch):
    engine = make_engine("busy")
    liveness = engine.liveness
    go_on = _blocked(engine)
    wait_for(lambda: liveness.state()["status"] == "busy")
    liveness.beat()
    assert not liveness.beat()
    assert engine.health()["liveness"]["dispatcher_s"] > 0
    monkeypatch.setattr(module, "BUSY_SECONDS", 0.0)
    assert liveness.state()["status"] == "stalled"
    go_on.set()
    wait_for(lambda: liveness.state()["status"] == "ok")
    wait_for(liveness.beat)


def test_a_thread_that_hangs_outside_of_callbacks_is_stalled(make_engine, monkeypatch):
    engine = make_engine("hung")
    go_on, receiver = threading.Event(), engine._session.dispatcher.receiver
    receive = receiver.receive

    def hang(timeout):
        go_on.wait(60)
        return receive(timeout)

    monkeypatch.setattr(receiver, "receive", hang)
    monkeypatch.setattr(module, "STALLED_SECONDS", 1.0)
    receiver.wake()
    wait_for(lambda: engine.liveness.state()["status"] == "stalled")
    go_on.set()
    wait_for(lambda: engine.liveness.state()["status"] == "ok")


def test_a_heartbeat_thread_that_does_not_go_round_is_stalled(make_engine, monkeypatch):
    engine = make_engine("unkept")
    monkeypatch.setattr(module, "STALLED_SECONDS", 1.0)
    with engine._session.heartbeats.lock:
        wait_for(lambda: engine._session.liveness.state()["status"] == "stalled")
        assert not engine._session.liveness.beat()
    wait_for(lambda: engine.liveness.state()["status"] == "ok")
