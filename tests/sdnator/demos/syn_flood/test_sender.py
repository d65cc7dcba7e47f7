"""What is sent is what was made, all of it, many frames a call."""

import socket

import numpy as np

from sdnator.demos.syn_flood.frames import FloodFrames
from sdnator.demos.syn_flood.sender import FrameBatch, send_flood


def rows(count: int):
    return np.random.default_rng(1).integers(0, 256, (count, 54), dtype=np.uint8)


def test_batch_sends_a_range():
    """Several frames with one call, each as it was."""
    frames = rows(20)
    mine, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with mine, theirs:
        assert FrameBatch(frames).send(mine.fileno(), 3, 8) == 5
        assert [theirs.recv(100) for _ in range(5)] == [row.tobytes() for row in frames[3:8]]


def test_refused_frames_are_counted_and_passed_over():
    """The far end is gone: nothing is sent, nothing hangs."""
    mine, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with mine:
        theirs.close()
        sent = send_flood(mine, FloodFrames(rows(7), np.zeros(7)), lambda _: None)
    assert (sent.sent, sent.failed) == (0, 7)


def test_flood_is_sent_to_the_end():
    """Every frame once, in order; the report has them all, and when it began."""
    frames, begun = rows(50), []
    mine, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    theirs.setblocking(False)
    with mine, theirs:
        mine.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
        # a datagram socket's queue is short: the receiver takes what there is at every begin
        for part in np.split(frames, 10):
            report = send_flood(mine, FloodFrames(part, np.arange(5) / 1000), begun.append)
            assert [theirs.recv(100) for _ in part] == [row.tobytes() for row in part]
            assert report.sent == 5
            assert report.first == begun[-1]
            assert sum(number for _, number in report.tally) == 5


def test_flood_ends_before_its_time():
    """When it is enough; the report says what was sent."""
    mine, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with mine, theirs:
        report = send_flood(mine, FloodFrames(rows(2), np.array([0.0, 3600.0])), lambda _: None, lambda: True)
    assert report.sent == 1
