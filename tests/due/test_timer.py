"""An alarm rings when it was set last to ring, and who waits is not woken up when it is set later."""

import math
import threading
import time

import pytest

from due.timer import KernelTimer, PlainTimer, Timer, new_timer

PATIENCE = 30.0


@pytest.fixture(params=[KernelTimer, PlainTimer])
def alarm(request):
    made: Timer = request.param()
    yield made
    made.close()


def _waiting(alarm: Timer) -> threading.Thread:
    thread = threading.Thread(target=alarm.wait, daemon=True)
    thread.start()
    return thread


def test_it_does_not_ring_before_its_time(alarm):
    due = time.monotonic() + 0.05
    alarm.set(due)
    alarm.wait()
    assert time.monotonic() >= due


def test_a_time_that_has_passed_rings_at_once(alarm):
    alarm.set(0.0)
    alarm.wait()


def test_who_waits_for_nothing_hears_of_an_earlier_time(alarm):
    alarm.set(math.inf)
    thread = _waiting(alarm)
    alarm.set(time.monotonic() + 1e6)
    alarm.set(0.0)
    thread.join(PATIENCE)
    assert not thread.is_alive()


def test_the_time_it_was_set_to_before_is_forgotten(alarm):
    alarm.set(time.monotonic() + 0.02)
    due = time.monotonic() + 0.1
    alarm.set(due)
    alarm.wait()
    assert time.monotonic() >= due


def test_a_closed_one_may_be_set():
    alarm = new_timer()
    alarm.close()
    alarm.set(0.0)
