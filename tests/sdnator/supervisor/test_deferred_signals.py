"""A stop signal never comes between the start of a process and its being known."""

import os
import signal
import threading

import pytest

from sdnator.supervisor.deferred_signals import deferred_signals


class Stopped(Exception):
    """What the handler under test raises."""


@pytest.fixture
def handled():
    """SIGTERM raises Stopped."""

    def stop(*_):
        raise Stopped

    before = signal.signal(signal.SIGTERM, stop)
    yield
    signal.signal(signal.SIGTERM, before)


def test_a_signal_inside_is_handled_on_leaving(handled):
    steps = []

    def start():
        with deferred_signals():
            os.kill(os.getpid(), signal.SIGTERM)
            steps.append("after the signal")

    with pytest.raises(Stopped):
        start()
    assert steps == ["after the signal"]


def test_signals_before_and_after_are_handled_at_once(handled):
    with deferred_signals():
        pass
    with pytest.raises(Stopped):
        os.kill(os.getpid(), signal.SIGTERM)


def test_an_error_inside_does_not_lose_the_signal(handled):
    def start():
        with deferred_signals():
            os.kill(os.getpid(), signal.SIGTERM)
            raise ValueError("the start failed")

    with pytest.raises(Stopped) as caught:
        start()
    assert isinstance(caught.value.__context__, ValueError)


def test_ignored_signals_stay_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with deferred_signals():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_other_threads_are_left_alone(handled):
    handlers = []

    def work():
        with deferred_signals():
            handlers.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=work)
    before = signal.getsignal(signal.SIGTERM)
    thread.start()
    thread.join()
    assert handlers == [before]
