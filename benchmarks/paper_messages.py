"""Findings 1 to 4: latency and throughput of one producer and one consumer, each a process, against os-ken and raw Redis.

Payloads are random bytes, the same for all peers.  DUE runs as apps do: under a Coordinator, with declared keys, best
effort and reliable, at its default settings; a batch is written and its last item sent without waiting.  Beside os-ken,
whose events stay in one process, it also runs in one process, over memory://.
"""

import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from benchmarks import osken
from benchmarks.pairs import CHANNEL, other_process, publish_stamped, raw_client
from benchmarks.paper_findings import Measured
from due import CONSUMER, NO_WAIT, PRODUCER, PUB_ONLY, Capability, Engine, Interest, Item, Options
from due.drivers.embedded_redis import EmbeddedServer
from due.messages import Delivery
from sdnator.testing.waiting import wait_for

SIZES: Final = (100, 1_000, 10_000, 100_000)
BATCHES: Final = (1, 100)
_GAP_S: Final = 0.001
_BYTES: Final = 100_000_000
"""Least of this and of the number of messages bounds a run of throughput."""
_WAIT_S: Final = 120.0

_OSKEN: Final = "os-ken {} B batch 1"
"""Its events have no batches."""
_MEMORY: Final = "due in one process {} B batch 1"

Latencies = list[float]


def figures(rounds: int, *, quick: bool) -> tuple[dict[int, dict[str, Measured]], dict[str, Any]]:
    """Findings 1 to 4 by number, and all cells."""
    sizes = (100, 1_000) if quick else SIZES
    cells: dict[str, list[dict[str, float]]] = {}
    with (
        tempfile.TemporaryDirectory() as folder,
        EmbeddedServer(folder) as server,
        _coordinator(server.url, folder),
    ):
        for _ in range(rounds):
            for size in sizes:
                if osken.available():
                    cells.setdefault(_OSKEN.format(size), []).append(_osken(size, quick=quick))
                    few = _latencies(_in_process_us(size, 300 if quick else 1_000))
                    cells.setdefault(_MEMORY.format(size), []).append(few)
                for batch in BATCHES:
                    for name, cell in _cells(server.url, folder, size, batch, quick=quick).items():
                        cells.setdefault(name, []).append(cell)
    return _findings(cells), {
        name: {field: Measured(tuple(one[field] for one in some)).to_value() for field in some[0]}
        for name, some in cells.items()
    }


def _findings(cells: dict[str, list[dict[str, float]]]) -> dict[int, dict[str, Measured]]:
    def ratios(above: str, below: str, field: str) -> Measured:
        return Measured(tuple(a[field] / b[field] for a, b in zip(cells[above], cells[below], strict=True)))

    due = "due best_effort {} B batch {}".format
    raw = "raw {} B batch {}".format
    found = {
        2: {
            f"latency_to_raw_batch{n}": ratios(due(1_000, n), raw(1_000, n), "latency_p50_us")
            for n in BATCHES
        }
        | {
            f"latency_to_raw_{size}_B_batch{n}": ratios(due(size, n), raw(size, n), "latency_p50_us")
            for size in SIZES
            for n in BATCHES
            if size != 1_000 and due(size, n) in cells
        },
        3: {"batch100_to_batch1": ratios(due(1_000, 100), due(1_000, 1), "per_second")},
        4: {"per_second": Measured(tuple(one["per_second"] for one in cells[due(100, 100)]))},
    }
    events = _OSKEN.format(1_000)
    if events in cells:
        found[1] = {
            "latency_to_osken": ratios(due(1_000, 1), events, "latency_p50_us"),
            "in_one_process_to_osken": ratios(_MEMORY.format(1_000), events, "latency_p50_us"),
            "osken_p50_us": Measured(tuple(one["latency_p50_us"] for one in cells[events])),
            "due_p50_us": Measured(tuple(one["latency_p50_us"] for one in cells[due(1_000, 1)])),
        }
    return found


def _osken(size: int, *, quick: bool) -> dict[str, float]:
    return {
        **_latencies(osken.latency_us(size, 300 if quick else 1_000)),
        "per_second": osken.events_per_second(size, 5_000 if quick else 20_000),
    }


def _latencies(times: Latencies) -> dict[str, float]:
    ordered = sorted(times)
    return {
        "latency_p50_us": ordered[len(ordered) // 2],
        "latency_p99_us": ordered[int(0.99 * (len(ordered) - 1))],
    }


def _cells(url: str, folder: str, size: int, batch: int, *, quick: bool) -> dict[str, dict[str, float]]:
    payload = os.urandom(size)
    few = 300 if quick else 1_000
    many = max(batch * 10, min(20_000 if batch == 1 else 200_000, _BYTES // size) // (4 if quick else 1))
    many = many // batch * batch
    found = {}
    for delivery in ("best_effort", "reliable"):
        arguments = (url, f"{folder}/due", delivery, batch)
        found[f"due {delivery} {size} B batch {batch}"] = _cell(
            partial(_due, arguments, payload), few, many, batch
        )
    found[f"raw {size} B batch {batch}"] = _cell(partial(_raw, url, payload, batch), few, many, batch)
    return found


def _cell(
    run: Callable[[int, float], tuple[Latencies, float]], few: int, many: int, batch: int
) -> dict[str, float]:
    times, _ = run(max(few, batch * 10) // batch * batch, _GAP_S)
    _, seconds = run(many, 0.0)
    return {**_latencies(times), "per_second": many / seconds}


def _due(
    arguments: tuple[str, str, str, int], payload: bytes, count: int, gap: float
) -> tuple[Latencies, float]:
    url, folder, delivery, batch = arguments
    key = f"bench.{delivery}.paper.message"
    with other_process(_due_consumer, url, folder, key, count) as pipe:
        engine = _engine(url, folder)
        chosen: Delivery = "reliable" if delivery == "reliable" else "best_effort"
        engine.init("paper_producer", PRODUCER, capabilities=(Capability(key, delivery=chosen),))
        wait_for(engine.assignments, _WAIT_S)
        begun = time.monotonic()
        for number in range(1, count + 1):
            last = number % batch == 0
            engine.write(key, payload, [PUB_ONLY, NO_WAIT] if last else [PUB_ONLY])
            if last and gap:
                time.sleep(gap)
        times, ended = _answer(pipe)
        engine.close()
    return times, ended - begun


def _due_consumer(pipe: Connection, url: str, folder: str, key: str, count: int) -> None:
    engine = _engine(url, folder)
    engine.init("paper_consumer", CONSUMER, interests=(Interest(key),))
    times: Latencies = []
    done: list[float] = []

    def callback(item: Item) -> None:
        times.append((time.time_ns() - item.timestamp) / 1_000)
        if len(times) == count:
            done.append(time.monotonic())

    engine.observe(key).subscribe(callback)
    pipe.send("ready")
    wait_for(lambda: done, _WAIT_S)
    pipe.send((times[:5_000], done[0]))
    engine.close()


def _engine(url: str, folder: str) -> Engine:
    return Engine(Options(updates=url, archive="memory://", directory=folder))


def _in_process_us(size: int, count: int) -> Latencies:
    """One-way times of messages sent one by one within this process, µs."""
    url, key, times, payload = (
        f"memory://paper-{os.getpid()}",
        "bench.paper.memory.message",
        [],
        os.urandom(size),
    )
    options = Options(updates=url, archive=url, coordinated=False)
    consumer, producer = Engine(options), Engine(options)
    consumer.init("paper_consumer", CONSUMER, interests=(Interest(key),))
    consumer.observe(key).subscribe(lambda item: times.append((time.time_ns() - item.timestamp) / 1_000))
    producer.init("paper_producer", PRODUCER, capabilities=(Capability(key),))
    for _ in range(count):
        producer.write(key, payload, [PUB_ONLY, NO_WAIT])
        time.sleep(_GAP_S)
    wait_for(lambda: len(times) == count, _WAIT_S)
    producer.close()
    consumer.close()
    return times


def _raw(url: str, payload: bytes, batch: int, count: int, gap: float) -> tuple[Latencies, float]:
    with other_process(_raw_consumer, url, count) as pipe:
        client = raw_client(url)
        begun = time.monotonic()
        publish_stamped(client, payload[8:], batch, count, gap)
        times, ended = _answer(pipe)
        client.close()
    return times, ended - begun


def _raw_consumer(pipe: Connection, url: str, count: int) -> None:
    subscriber: Any = raw_client(url).pubsub()  # type: ignore[no-untyped-call]
    subscriber.subscribe(CHANNEL)
    subscriber.get_message(timeout=5)
    pipe.send("ready")
    times: Latencies = []
    while len(times) < count:
        message = subscriber.get_message(timeout=5)
        if message is not None and message["type"] == "message":
            times.append((time.time_ns() - struct.unpack_from("<q", message["data"])[0]) / 1_000)
    pipe.send((times[:5_000], time.monotonic()))
    subscriber.close()


def _answer(pipe: Connection) -> tuple[Latencies, float]:
    if not pipe.poll(_WAIT_S):
        raise RuntimeError(f"not all messages arrived within {_WAIT_S:g} s")
    times, ended = pipe.recv()
    return times, ended


@contextmanager
def _coordinator(url: str, folder: str) -> Iterator[None]:
    command = [sys.executable, "-m", "coordinator.service", "--updates", url]
    command += ["--archive", f"sqlite://{folder}/coordinator.db", "--directory", folder, "--log", "error"]
    process = subprocess.Popen(command, cwd=Path(__file__).parents[1], stdout=subprocess.PIPE)
    try:
        if process.stdout is None or not process.stdout.readline():
            raise RuntimeError("the Coordinator did not start")
        yield
    finally:
        process.terminate()
        process.wait(30)
