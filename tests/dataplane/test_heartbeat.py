"""Signs of life stop as soon as one of the threads does not turn."""

import os
import select
from contextlib import suppress

import pytest

from dataplane.heartbeat import HeartbeatError, LivenessPipe
from sdnator.testing.p4runtime_client import TIMEOUT_S

FAST_S = 0.02


class Loop:
    def __init__(self):
        self.turns, self.hangs, self.asked = 0, False, 0

    def ask(self):
        self.asked += 1
        self.turns += not self.hangs


@pytest.fixture
def pipe():
    read, write = os.pipe()
    yield read, write
    os.close(read)
    os.close(write)


def comes(read):
    return bool(select.select([read], [], [], TIMEOUT_S)[0]) and os.read(read, 1) == b"."


def test_the_beat_tells_how_often_an_array_was_left(pipe):
    read, write = pipe
    counts = iter([0, 17])
    heart = LivenessPipe(write, [Loop()], FAST_S, lambda: next(counts, 17))
    heart.start()
    told = b""
    while told.count(b";") < 2:
        assert select.select([read], [], [], TIMEOUT_S)[0]
        told += os.read(read, 100)
    heart.stop()
    assert told.startswith(b"..17;.17;")


@pytest.mark.parametrize("which", [0, 1])
def test_both_have_to_turn(pipe, which):
    read, write = pipe
    loops = (Loop(), Loop())
    heart = LivenessPipe(write, loops, FAST_S)
    heart.start()
    assert comes(read)
    loops[which].hangs = True
    other = loops[1 - which]
    while True:  # a byte may have been on its way; of twenty rounds one is enough
        os.set_blocking(read, False)
        try:
            os.read(read, 1)
        except BlockingIOError:
            if not select.select([read], [], [], 20 * FAST_S)[0]:
                break
    loops[which].hangs, loops[which].turns = False, loops[which].turns + 1
    other.turns += 1
    assert comes(read)
    heart.stop()


def test_a_full_pipe_holds_nobody_up(pipe):
    read, write = pipe
    loop = Loop()
    heart = LivenessPipe(write, [loop], FAST_S)
    with suppress(BlockingIOError):
        while True:
            os.write(write, bytes(4096))
    heart.start()
    while loop.asked < 5:
        select.select([], [], [], FAST_S)
    heart.stop()
    assert os.read(read, 4096) == bytes(4096)


def test_a_supervisor_that_is_gone_is_no_fault():
    read, write = os.pipe()
    os.close(read)
    loop = Loop()
    heart = LivenessPipe(write, [loop], FAST_S)
    heart.start()
    while loop.asked < 5:
        select.select([], [], [], FAST_S)
    heart.stop()
    os.close(write)


def test_a_descriptor_that_is_not_open_is_an_error():
    with pytest.raises(HeartbeatError, match="heartbeat descriptor 1999"):
        LivenessPipe(1999, [])
