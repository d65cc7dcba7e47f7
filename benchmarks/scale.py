"""How many pairs fit on one machine, how fairly, and what 100 apps cost the Coordinator.

`python -m benchmarks.scale --json FILE`.  Each pair is two processes with a reliable key of its own, writing
as fast as the consumer takes it.  In between the same layout runs with redis-py alone: what it loses with many
pairs is lost to the machine, for which each switch between processes costs a cold cache.  The Coordinator hears
100 apps beating at 10 Hz.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median

from benchmarks import worker
from benchmarks.measure import arguments, bars, machine, table, write_json
from benchmarks.pairs import end_of_writing, raw_stream_consumer, raw_stream_producer, tell_rate
from due import CONSUMER, PRODUCER, PUB_ONLY, Capability, Engine, Interest, Item, Options
from due.codec import Frame, decode_frame, encode_frame, freeze
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis import RedisUpdates
from due.membership import Assignments, Heartbeat, Member, Registration

PAIRS = (1, 2, 5, 10, 20, 30)
RAW_PAIRS = (1, 2, 30)
SECONDS = 4.0
SECONDS_PER_PAIR = 0.4
"""The more pairs share the cores, the longer it takes until each had the same number of turns."""
SIZE = 100
APPS, BEAT = 100, 0.1
_WINDOW = 1 << 20

Side = Callable[[Connection, str, int, float], None]
"""A producer or a consumer: its pipe, the server, the number of its pair, seconds."""


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, write."""
    options = arguments("scale", __doc__, rounds=3).parse_args(argv)
    aggregate: dict[str, float] = {}
    raw: dict[str, float] = {}
    fairness: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder, EmbeddedServer(folder) as server:
        for pairs in PAIRS:
            seconds = max(1.0, max(SECONDS, SECONDS_PER_PAIR * pairs) * options.scale)
            rounds, raw_rounds = [], []
            for _ in range(options.rounds):
                rounds.append(_run(server.url, pairs, seconds, _consumer, _producer))
                if pairs in RAW_PAIRS:
                    raw_rounds.append(
                        _run(server.url, pairs, seconds, raw_stream_consumer, raw_stream_producer)
                    )
            aggregate[str(pairs)] = median(map(sum, rounds))
            if raw_rounds:
                raw[str(pairs)] = median(map(sum, raw_rounds))
            fairness[str(pairs)] = median(min(rates) / max(rates) for rates in rounds)
        share = coordinator_share(server.url, folder, max(2.0, 2 * SECONDS * options.scale))
    table(
        ["pairs", "messages/s", "share of the best", "min / max", "redis-py", "share of its best"],
        [
            [p, total, total / max(aggregate.values()), fairness[p]]
            + ([raw[p], raw[p] / max(raw.values())] if p in raw else ["-", "-"])
            for p, total in aggregate.items()
        ],
    )
    bars("messages/s of all pairs together", aggregate)
    print(f"Coordinator with {APPS} apps at {1 / BEAT:.0f} Hz: {share:.1%} of a core")
    figures = {"aggregate_by_pairs": aggregate, "fairness_by_pairs": fairness, "raw_aggregate_by_pairs": raw}
    write_json(options.json, {"machine": machine(), **figures, "coordinator_cpu_share": share})
    return 0


def _run(url: str, pairs: int, seconds: float, consumer: Side, producer: Side) -> list[float]:
    """Messages a second of each pair, counted by the consumers in one common span of time."""
    pipes: list[Connection] = []
    processes = []
    for number in range(pairs):
        for target in (consumer, producer):
            process, pipe = worker.start(target, url, number, seconds)
            processes.append(process)
            pipes.append(pipe)
    for pipe in pipes:
        _answer(pipe)
    start = time.time() + 0.5
    for pipe in pipes:
        pipe.send(start)
    rates = [float(_answer(pipe)) for pipe in pipes[::2]]
    for process in processes:
        process.kill()  # a producer may be held back by its reader, which has left without a word
        process.join()
    return rates


def _answer(pipe: Connection) -> float:
    if not pipe.poll(120):
        raise RuntimeError("a process did not answer within 120 s")
    return float(pipe.recv())


def _options() -> Options:
    return Options(coordinated=False, window_bytes=_WINDOW, retain_bytes=_WINDOW)


def _producer(pipe: Connection, url: str, number: int, seconds: float) -> None:
    key = f"bench.scale.p{number}.x"
    engine = Engine(_options())
    engine.set_pubsub(url)
    engine.init(f"producer{number}", PRODUCER, capabilities=[Capability(key, delivery="reliable")])
    payload = bytes(SIZE)
    end = end_of_writing(pipe, seconds)
    while time.time() < end:
        for _ in range(500):
            engine.write(key, payload, [PUB_ONLY])
    os._exit(0)


def _consumer(pipe: Connection, url: str, number: int, seconds: float) -> None:
    engine = Engine(_options())
    engine.set_pubsub(url)
    engine.init(f"consumer{number}", CONSUMER)
    count = [0]

    def callback(_item: Item) -> None:
        count[0] += 1

    engine.observe(f"bench.scale.p{number}.x").subscribe(callback)
    tell_rate(pipe, count, seconds)


def coordinator_share(url: str, folder: str, seconds: float) -> float:
    """CPU share of a real Coordinator that hears `APPS` apps."""
    archive = f"sqlite://{Path(folder) / 'coordinator.db'}"
    command = [
        sys.executable,
        "-m",
        "coordinator.service",
        "--updates",
        url,
        "--archive",
        archive,
        "--log",
        "warning",
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        json.loads(process.stdout.readline())
        crowd = _Crowd(url, [_member(number) for number in range(APPS)])
        crowd.beat(2.0)
        before, began = _cpu_seconds(process.pid), time.monotonic()
        crowd.beat(seconds)
        share = (_cpu_seconds(process.pid) - before) / (time.monotonic() - began)
        crowd.close()
    finally:
        process.terminate()
        process.communicate(timeout=20)
    return share


def _member(number: int) -> Member:
    registration = Registration(
        app_id=f"app{number}",
        instance_id=f"instance{number}",
        revision=1,
        capabilities=(Capability(f"bench.made.app{number}.x"),),
        interests=(Interest(f"bench.made.app{(number + 1) % APPS}.*"),),
        heartbeat=BEAT,
        started=time.time_ns(),
    )
    return Member(registration, now=time.monotonic(), handshake_timeout=1.0)


class _Crowd:
    """The members' side of the conversation with the Coordinator, over one connection."""

    def __init__(self, url: str, members: list[Member]) -> None:
        driver = RedisUpdates(url)
        self._publisher = driver.publisher("crowd")
        self._receiver = driver.receiver("crowd", "crowd")
        self._receiver.subscribe("due.assignment.*")
        self._members = {member.registration.app_id: member for member in members}
        self._sent: Counter[str] = Counter()

    def beat(self, seconds: float) -> None:
        """Register, beat and listen for so long."""
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end:
            for member in self._members.values():
                for message in member.tick(now):
                    self._send(message)
            for delivery in self._receiver.receive(0.01):
                said = Assignments.from_value(decode_frame(delivery.payload).values[0])
                if said.app_id in self._members:
                    self._members[said.app_id].assigned(said, time.monotonic())

    def close(self) -> None:
        """Disconnect."""
        self._publisher.close()
        self._receiver.close()

    def _send(self, message: Registration | Heartbeat) -> None:
        kind = "registration" if isinstance(message, Registration) else "heartbeat"
        path = f"due.{kind}.{message.app_id}"
        count = self._sent[path]
        self._sent[path] += 1
        now, value = [time.time_ns()], [freeze(message.to_value())]
        frame = Frame(path, message.app_id, message.instance_id, 0, count + 1, count, now, None, value)
        self._publisher.publish(path, encode_frame(frame))


def _cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    sys.exit(main())
