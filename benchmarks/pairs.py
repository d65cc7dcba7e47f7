"""A producer here and a consumer in another process, for DUE and for its peers.

Each `run_*` sends `count` messages and returns messages per second, from the first write until the
last callback in the other process.  Best-effort messages may be lost, as when a server cuts a subscriber off:
DUE's rate is of those that arrived, and `due_delivery` tells how many these were.
"""

import os
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, NoReturn

import msgspec
import redis

from benchmarks import worker
from due import CONSUMER, PRODUCER, PUB_ONLY, Capability, Engine, Item, Options, RecordBatch

FRAME = 860
"""Messages of 100 bytes in a frame of DUE."""
_MOST_FRAMES = 8
_AROUND_S = 0.3
KEY = "bench.pairs.app.message"
CHANNEL = "bench"
_STILL_S = 20.0
"""After this long without a message, once all are written, the rest is lost: longer than any reconnection."""


class MeasuredRun(NamedTuple):
    """What came of the messages of one run."""

    rate: float
    """Messages a second, of those that arrived."""
    lost: int


def engine(url: str, app: str, role: Any, *, reliable: bool = False, **options: Any) -> Engine:
    """An engine without a Coordinator; `reliable`: it writes KEY so."""
    made = Engine(Options(coordinated=False, **options))
    made.set_pubsub(url)
    made.init(app, role, capabilities=[Capability(KEY, delivery="reliable")] if reliable else [])
    return made


def raw_client(url: str) -> redis.Redis:
    """redis-py as fast as it goes: RESP2 and hiredis."""
    return redis.Redis.from_url(url, protocol=2, socket_timeout=None)


def publish_stamped(client: redis.Redis, rest: bytes, batch: int, count: int, gap: float) -> None:
    """Publish messages by redis-py, each its time (ns, 8 bytes) and `rest`, `batch` at once, `gap` seconds apart."""
    for _ in range(count // batch):
        if batch == 1:
            client.publish(CHANNEL, struct.pack("<q", time.time_ns()) + rest)
        else:
            pipeline = client.pipeline(transaction=False)
            for _ in range(batch):
                pipeline.publish(CHANNEL, struct.pack("<q", time.time_ns()) + rest)
            pipeline.execute()
        if gap:
            time.sleep(gap)


@contextmanager
def other_process(target: Callable[..., None], *arguments: Any) -> Iterator[Connection]:
    """Runs `target(pipe, ...)` in another process; it sends "ready" first."""
    process, here = worker.start(target, *arguments)
    try:
        assert here.recv() == "ready"
        yield here
    finally:
        process.join(5)
        if process.is_alive():
            process.terminate()
            process.join()
        here.close()


def run_due(url: str, size: int, count: int) -> float:
    """DUE with its defaults, one callback per message."""
    found = due_delivery(url, size, count)
    if found.lost:
        print(f"{found.lost} of {count} best-effort messages of {size} bytes were lost")
    return found.rate


def due_delivery(
    url: str,
    size: int,
    count: int,
    consumers_url: str = "",
    *,
    reliable: bool = False,
    still: float = _STILL_S,
) -> MeasuredRun:
    """The same, and how many messages were lost; the consumer may have a credential of its own."""
    with other_process(_due_consumer, consumers_url or url, count, "consumer", still) as pipe:
        producer = engine(url, "producer", PRODUCER, reliable=reliable)
        payload, write = bytes(size), producer.write
        flags = [PUB_ONLY]
        start = time.monotonic()
        for _ in range(count):
            write(KEY, payload, flags)
        producer.flush()
        pipe.send("written")
        ended, left = _arrived(pipe)
        producer.close()
    if left and reliable:
        raise RuntimeError(f"{left} of {count} reliable messages did not arrive")
    return MeasuredRun((count - left) / (ended - start), left)


def producer_cost(url: str, size: int, count: int, consumers: int) -> float:
    """CPU seconds of the producer per million messages with so many consumers of one stream."""
    with ExitStack() as stack:
        pipes = [
            stack.enter_context(other_process(_due_consumer, url, count, f"c{n}")) for n in range(consumers)
        ]
        producer = engine(url, "producer", PRODUCER)
        payload, write = bytes(size), producer.write
        before = time.process_time()
        for _ in range(count):
            write(KEY, payload, [PUB_ONLY])
        producer.flush()
        cost = (time.process_time() - before) / count * 1e6
        for pipe in pipes:
            _arrived(pipe)
        producer.close()
    return cost


def raw_producer_cost(url: str, size: int, count: int, consumers: int) -> float:
    """The same with redis-py and frames of 100 messages: what the machine adds for more consumers."""
    frames = count // 100
    with ExitStack() as stack:
        pipes = [stack.enter_context(other_process(_frame_consumer, url, frames)) for _ in range(consumers)]
        client, payload, encoder = raw_client(url), bytes(size), msgspec.msgpack.Encoder()
        before = time.process_time()
        for _ in range(frames):
            messages = []
            for _ in range(100):
                messages.append(payload)  # noqa: PERF401 - one by one, as an app writes
            client.publish(CHANNEL, encoder.encode(messages))
        cost = (time.process_time() - before) / count * 1e6
        for pipe in pipes:
            _finished(pipe)
        client.close()
    return cost


def run_records(url: str, rows: int, count: int) -> float:
    """DUE with record batches of `rows` packet headers; records per second."""
    import numpy as np

    batch = RecordBatch(
        {
            "time_us": np.arange(rows, dtype="i8"),
            "source": np.arange(rows, dtype="u4"),
            "destination": np.arange(rows, dtype="u4"),
            "source_port": np.zeros(rows, "u2"),
            "destination_port": np.zeros(rows, "u2"),
            "length": np.zeros(rows, "u2"),
            "protocol": np.zeros(rows, "u1"),
            "flags": np.zeros(rows, "u1"),
        }
    )
    with other_process(_due_consumer, url, count) as pipe:
        producer = engine(url, "producer", PRODUCER)
        start = time.monotonic()
        for _ in range(count):
            producer.write(KEY, batch, [PUB_ONLY])
        rate = rows * count / (_arrived(pipe)[0] - start)
        producer.close()
    return rate


def run_one_by_one(url: str, size: int, count: int) -> float:
    """redis-py: one PUBLISH per message."""
    with other_process(_raw_consumer, url, count) as pipe:
        client = raw_client(url)
        payload = bytes(size)
        start = time.monotonic()
        for _ in range(count):
            client.publish(CHANNEL, payload)
        rate = count / (_finished(pipe) - start)
        client.close()
    return rate


def run_pipeline100(url: str, size: int, count: int) -> float:
    """redis-py: pipelines of 100 PUBLISHes."""
    with other_process(_raw_consumer, url, count) as pipe:
        client = raw_client(url)
        payload = bytes(size)
        start = time.monotonic()
        for _ in range(count // 100):
            pipeline = client.pipeline(transaction=False)
            for _ in range(100):
                pipeline.publish(CHANNEL, payload)
            pipeline.execute()
        rate = count / (_finished(pipe) - start)
        client.close()
    return rate


def run_raw_frames(url: str, size: int, count: int) -> float:
    """redis-py: frames of 100 messages, decoded to a list, without callbacks: the bound for any framing."""
    with other_process(_frame_consumer, url, count // 100) as pipe:
        client = raw_client(url)
        payload = bytes(size)
        encoder = msgspec.msgpack.Encoder()
        start = time.monotonic()
        for _ in range(count // 100):
            client.publish(CHANNEL, encoder.encode([payload] * 100))
        rate = count / (_finished(pipe) - start)
        client.close()
    return rate


def _finished(pipe: Connection) -> float:
    if not pipe.poll(120):
        raise RuntimeError("the consumer did not receive everything within 120 s")
    return float(pipe.recv())


def _arrived(pipe: Connection) -> tuple[float, int]:
    """When the last message arrived (monotonic, s), and how many did not."""
    if not pipe.poll(120):
        raise RuntimeError("the consumer did not receive everything within 120 s")
    ended, left = pipe.recv()
    return float(ended), int(left)


def _due_consumer(
    pipe: Connection, url: str, count: int, app: str = "consumer", still: float = _STILL_S
) -> None:
    consumer = engine(url, app, CONSUMER)
    left, ended = [count], [0.0]

    def callback(_item: Item) -> None:
        if left[0] == 1:
            ended[0] = time.monotonic()
        left[0] -= 1

    consumer.observe(KEY).subscribe(callback)
    pipe.send("ready")
    before, changed = count, time.monotonic()
    while left[0] > 0:
        time.sleep(0.02)
        now, there = time.monotonic(), left[0]
        if there != before or not pipe.poll():  # until the producer says so, there is more to come
            before, changed = there, now
        elif now - changed > still:
            pipe.send((changed, there))
            break
    else:
        pipe.send((ended[0], 0))
    consumer.close()


def _raw_consumer(pipe: Connection, url: str, count: int) -> None:
    left = [count]

    def callback(_data: bytes) -> None:
        left[0] -= 1
        if not left[0]:
            pipe.send(time.monotonic())

    _listen(pipe, url, count, callback)


def _frame_consumer(pipe: Connection, url: str, frames: int) -> None:
    left = [frames]
    decoder = msgspec.msgpack.Decoder(list[Any])

    def callback(data: bytes) -> None:
        decoder.decode(data)
        left[0] -= 1
        if not left[0]:
            pipe.send(time.monotonic())

    _listen(pipe, url, frames, callback)


def _listen(pipe: Connection, url: str, messages: int, callback: Callable[[bytes], None]) -> None:
    client: Any = raw_client(url)
    subscriber = client.pubsub(ignore_subscribe_messages=False)
    subscriber.subscribe(CHANNEL)
    subscriber.get_message(timeout=5)
    pipe.send("ready")
    while messages:
        message = subscriber.get_message(timeout=5)
        if message is not None and message["type"] == "message":
            callback(message["data"])
            messages -= 1
    subscriber.close()
    client.close()


def end_of_writing(pipe: Connection, seconds: float) -> float:
    """Report as ready and wait for the common start; producers write from before it until after its end."""
    pipe.send(0)
    start = float(pipe.recv())
    time.sleep(max(0.0, start - time.time() - _AROUND_S))
    return start + seconds + _AROUND_S


def tell_rate(pipe: Connection, count: list[int], seconds: float) -> NoReturn:
    """Report as ready, count in the span that all consumers share, answer the rate, and leave at once."""
    pipe.send(0)
    start = float(pipe.recv())
    time.sleep(max(0.0, start - time.time()))
    began, before = time.time(), count[0]
    time.sleep(max(0.1, start + seconds - time.time()))
    pipe.send((count[0] - before) / (time.time() - began))
    os._exit(0)


def raw_stream_producer(pipe: Connection, url: str, number: int, seconds: float) -> None:
    """redis-py: frames of 100-byte messages on a stream, held back while more than a few are unread."""
    client: Any = raw_client(url)
    name, payload, encoder = f"bench:{number}", bytes(100), msgspec.msgpack.Encoder()
    end = end_of_writing(pipe, seconds)
    while time.time() < end:
        pipeline = client.pipeline(transaction=False)
        for _ in range(_MOST_FRAMES // 2):
            messages = []
            for _ in range(FRAME):
                messages.append(payload)  # noqa: PERF401 - one by one, as an app writes
            pipeline.xadd(name, {b"f": encoder.encode(messages)})
        pipeline.xlen(name)
        unread = pipeline.execute()[-1]
        while unread > _MOST_FRAMES and time.time() < end:
            time.sleep(0.003)  # to ask at once would cost the server more than the frames do
            unread = client.xlen(name)
    os._exit(0)


def raw_stream_consumer(pipe: Connection, url: str, number: int, seconds: float) -> None:
    """redis-py: a group's only reader; a callback for each message, frames acknowledged and removed."""
    client: Any = raw_client(url)
    name, count = f"bench:{number}", [0]
    client.delete(name)
    client.xgroup_create(name, "readers", "0", mkstream=True)

    def callback(_message: bytes) -> None:
        count[0] += 1

    threading.Thread(target=_read_stream, args=(client, name, callback), daemon=True).start()
    tell_rate(pipe, count, seconds)


def _read_stream(client: Any, name: str, callback: Callable[[bytes], None]) -> None:
    decoder = msgspec.msgpack.Decoder(list[bytes])
    done: list[bytes] = []
    while True:
        pipeline = client.pipeline(transaction=False)
        if done:
            pipeline.xack(name, "readers", *done)
            pipeline.xdel(name, *done)
        pipeline.xreadgroup("readers", "reader", {name: ">"}, count=16, block=1000)
        done = []
        for _, entries in pipeline.execute()[-1] or ():
            for token, fields in entries:
                for message in decoder.decode(fields[b"f"]):
                    callback(message)
                done.append(token)
