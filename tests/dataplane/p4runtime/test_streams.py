"""Streams send what is posted first, then their role's queue, and lose nothing when they end."""

import asyncio
import threading
from contextlib import suppress

from dataplane.p4runtime.status import InvalidArgument
from dataplane.p4runtime.streams import ControllerStream, PacketQueue


def connected(capacity=1000):
    rooms = []
    queue = PacketQueue(capacity, lambda: rooms.append(len(queue)))
    stream = ControllerStream(1)
    stream.queue, queue.reader = queue, stream
    return stream, queue, rooms


def sent(stream, count):
    """What a stream sends until its controller leaves with message number `count` on its way."""
    got = []

    async def write(message):
        got.append(message)
        if len(got) == count:
            raise asyncio.CancelledError

    with suppress(asyncio.CancelledError):
        asyncio.run(stream.send(write))
    return got


def test_messages_come_in_order_and_posted_ones_first():
    stream, queue, _ = connected()
    queue.put([b"%d" % n for n in range(200)])
    stream.post(b"hello")
    assert sent(stream, 201) == [b"hello", *(b"%d" % n for n in range(200))]


def test_what_a_stream_took_and_did_not_send_goes_to_the_next_one():
    stream, queue, _ = connected()
    queue.put([b"%d" % n for n in range(100)])
    assert sent(stream, 10) == [b"%d" % n for n in range(10)]
    assert queue.take()[0] == b"10"
    assert len(queue) == 90 - 64


def test_a_waiting_stream_is_woken():
    stream, queue, _ = connected()
    got = []
    reader = threading.Thread(target=lambda: got.extend(sent(stream, -1)))
    reader.start()
    for n in range(50):
        queue.put([b"%d" % n])
        stream.post(b"c")
    stream.end()
    reader.join(60)
    assert not reader.is_alive()
    assert got.count(b"c") == 50


def test_an_error_ends_a_stream_once():
    stream, _, _ = connected()
    stream.end(InvalidArgument("first"))
    stream.end(InvalidArgument("second"))
    assert sent(stream, -1) == []
    assert str(stream.error) == "first"


def test_room_is_announced_when_a_full_queue_is_half_empty():
    stream, queue, rooms = connected(capacity=100)
    queue.put([b"x"] * 100)
    assert queue.room() == 0
    sent(stream, 65)
    assert rooms == [36]
    assert queue.room() == 100 - len(queue)


def test_what_does_not_fit_is_refused_and_a_lossless_caller_may_go_beyond():
    _, queue, _ = connected(capacity=10)
    assert queue.put([b"x"] * 15) == 5
    assert queue.put([b"x"] * 100, lossless=True) == 70
    assert len(queue) == 40


def test_long_messages_weigh_more():
    _, queue, _ = connected(capacity=10)
    assert queue.put([bytes(9000)] * 5) == 3
    assert queue.room() == 0
    queue.take()
    assert queue.room() == 10


def test_clearing_counts_what_is_dropped():
    _, queue, _ = connected()
    queue.put([b"x"] * 7)
    assert queue.clear() == 7
    assert len(queue) == 0


def test_posted_messages_are_bounded():
    stream, _, _ = connected()
    for _ in range(5000):
        stream.post(b"x")
    assert stream.dropped == 5000 - 4096
