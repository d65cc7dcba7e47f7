"""A signal ends the wait, wherever in its code the signal comes."""

import os
import signal
import sys
import threading

import pytest

from dataplane.stop import Stop


@pytest.fixture
def stop():
    before = signal.getsignal(signal.SIGUSR1)
    stop = Stop((signal.SIGUSR1,))
    yield stop
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGUSR1, before)
    os.close(stop._read)
    os.close(stop._write)


def test_a_signal_before_the_wait_ends_it(stop):
    signal.raise_signal(signal.SIGUSR1)
    stop.wait()


def test_a_thread_ends_it(stop):
    threading.Timer(0.05, stop.set).start()
    stop.wait()


def test_a_signal_at_any_line_of_the_wait_ends_it(stop):
    """threading.Event fails here: its handler waits for the lock that the interrupted wait holds."""
    lines = []

    def trace(frame, event, _):
        if event == "line" and "test_stop" not in frame.f_code.co_filename:
            lines.append(frame.f_lineno)
            signal.raise_signal(signal.SIGUSR1)
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        stop.wait()
    finally:
        sys.settrace(before)
    assert lines


def test_setting_it_more_often_than_the_pipe_holds_does_not_block(stop):
    for _ in range(100_000):
        stop.set()
    stop.wait()
