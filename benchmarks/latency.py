"""How long one message takes from `write` to the callback in another process: DUE, raw redis-py, os-ken.

`python -m benchmarks.latency --json FILE`.  Batch 1: every message at once (NO_WAIT), one each millisecond.
Batch 100: a hundred messages written together, then sent.  The headline figures are those of 1 KB, batch 1,
Unix socket.  os-ken's figure is one process handing an event to itself.
"""

import statistics
import struct
import sys
import tempfile
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection

from benchmarks import osken
from benchmarks.measure import arguments, bars, machine, table, write_json
from benchmarks.pairs import CHANNEL, KEY, engine, other_process, publish_stamped, raw_client
from due import CONSUMER, NO_WAIT, PRODUCER, PUB_ONLY, Item
from due.drivers.embedded_redis import EmbeddedServer

SIZES = (100, 1000, 10_000)
MESSAGES = 2000
GAP = 0.001
Latencies = list[float]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, write."""
    options = arguments("latency", __doc__, rounds=3).parse_args(argv)
    count = max(200, int(MESSAGES * options.scale))
    cases: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as folder, EmbeddedServer(folder, tcp=True) as server:
        for transport, url in (("unix", server.url), ("tcp", server.tcp_url)):
            for size in SIZES:
                for batch in (1, 100):
                    cases.append({"transport": transport, "size": size, "batch": batch})
                    cases[-1].update(_case(url, size, batch, count, options.rounds))
    head = next(c for c in cases if (c["transport"], c["size"], c["batch"]) == ("unix", 1000, 1))
    os_ken = statistics.median(osken.latency_us(1000)) if osken.available() else None
    names = list(head)
    table(names, [[case[name] for name in names] for case in cases])
    shown = {"DUE p50": head["p50_us"], "raw p50": head["raw_p50_us"], "DUE p99": head["p99_us"]}
    bars("one way, 1 KB, Unix socket, microseconds", {k: float(str(v)) for k, v in shown.items()})
    print(osken.ABSENT if os_ken is None else f"os-ken p50: {os_ken:.1f} (in one process)")
    fields = ("p50_us", "p99_us", "raw_p50_us", "raw_p99_us", "ratio_vs_raw")
    figures = {name: head[name] for name in fields}
    write_json(options.json, {"machine": machine(), **figures, "osken_p50_us": os_ken, "cases": cases})
    return 0


def _case(url: str, size: int, batch: int, count: int, rounds: int) -> dict[str, float]:
    due: list[Latencies] = []
    raw: list[Latencies] = []
    for _ in range(rounds):
        due.append(one_way(url, size, batch, count, due=True))
        raw.append(one_way(url, size, batch, count, due=False))
    p50, raw_p50 = percentile(due, 0.5), percentile(raw, 0.5)
    return {
        "p50_us": p50,
        "p99_us": percentile(due, 0.99),
        "raw_p50_us": raw_p50,
        "raw_p99_us": percentile(raw, 0.99),
        "ratio_vs_raw": p50 / raw_p50,
    }


def percentile(rounds: Sequence[Latencies], share: float) -> float:
    """The median over the rounds."""
    return statistics.median(sorted(times)[int(share * (len(times) - 1))] for times in rounds)


def one_way(
    url: str, size: int, batch: int, count: int, *, due: bool = True, consumers_url: str = ""
) -> Latencies:
    """Microseconds of each message; the consumer may have a credential of its own."""
    consumer, producer = (_due_consumer, _due_producer) if due else (_raw_consumer, _raw_producer)
    total = count // batch * batch * (1 if batch == 1 else 10)
    with other_process(consumer, consumers_url or url, total) as pipe:
        producer(url, size, batch, total)
        if not pipe.poll(60):
            raise RuntimeError(f"not all of {total} messages arrived within 60 s")
        latencies: Latencies = pipe.recv()
    return latencies


def _due_producer(url: str, size: int, batch: int, count: int) -> None:
    made = engine(url, "producer", PRODUCER, linger=0.05, single_bytes=1 << 20, frame_bytes=1 << 22)
    payload = bytes(size)
    for number in range(1, count + 1):
        last = number % batch == 0
        made.write(KEY, payload, [PUB_ONLY, NO_WAIT] if last else [PUB_ONLY])
        if last:
            time.sleep(GAP)
    made.close()


def _raw_producer(url: str, size: int, batch: int, count: int) -> None:
    client = raw_client(url)
    publish_stamped(client, bytes(max(0, size - 8)), batch, count, GAP)
    client.close()


def _due_consumer(pipe: Connection, url: str, count: int) -> None:
    made = engine(url, "consumer", CONSUMER)
    times: Latencies = []

    def callback(item: Item) -> None:
        times.append((time.time_ns() - item.timestamp) / 1000)

    made.observe(KEY).subscribe(callback)
    pipe.send("ready")
    while len(times) < count:
        time.sleep(0.02)
    pipe.send(times)
    made.close()


def _raw_consumer(pipe: Connection, url: str, count: int) -> None:
    subscriber = raw_client(url).pubsub()  # type: ignore[no-untyped-call]
    subscriber.subscribe(CHANNEL)
    subscriber.get_message(timeout=5)
    pipe.send("ready")
    times: Latencies = []
    while len(times) < count:
        message = subscriber.get_message(timeout=5)
        if message is not None and message["type"] == "message":
            times.append((time.time_ns() - struct.unpack_from("<q", message["data"])[0]) / 1000)
    pipe.send(times)
    subscriber.close()


if __name__ == "__main__":
    sys.exit(main())
