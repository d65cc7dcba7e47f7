"""Small apps that fault tests start as processes and kill: `python -m tests.due.faults.programs NAME URL ...`."""

import sys
import time

from due import CONSUMER, PRODUCER, PUB_ONLY, Capability, Engine, Options

KEY = "fault.stream"
OPTIONS = Options(coordinated=False, window_bytes=4 << 20)


def _engine(url: str, app: str, role=PRODUCER | CONSUMER, **init) -> Engine:
    engine = Engine(OPTIONS)
    engine.set_pubsub(url)
    engine.init(app, role, **init)
    return engine


def produce(url: str, delivery: str, count: str, size: str) -> None:
    """Write numbered payloads and say where we are; the last line says that all is flushed."""
    engine = _engine(url, "maker", capabilities=[Capability(KEY, delivery=delivery)])
    padding = b"." * int(size)
    for number in range(int(count)):
        engine.write(KEY, [number, padding], [PUB_ONLY])
        if number % 1000 == 999:
            print(number + 1, flush=True)
    engine.flush(120)
    print("flushed", engine.health()["updates"]["resent"], flush=True)
    sys.stdin.readline()
    engine.close()


def consume(url: str, app: str, count: str, delay_ms: str) -> None:
    """Print `sequence number` of every item, `gaps N` at the end; stop after `count` items."""
    engine = _engine(url, app)
    left = [int(count)]
    delay = float(delay_ms) / 1000

    def callback(item) -> None:
        if delay:
            time.sleep(delay)
        sys.stdout.write(f"{item.sequence} {item.value[0]}\n")
        left[0] -= 1

    engine.observe(KEY).subscribe(callback)
    print("ready", flush=True)
    idle, before = 0.0, left[0]
    while left[0] > 0 and idle < 60:
        time.sleep(0.05)
        idle = idle + 0.05 if before == left[0] else 0.0
        before = left[0]
        sys.stdout.flush()
    receiving = engine.health()["receiving"]
    print("gaps", receiving["gaps"], "repeats", receiving["repeats"], flush=True)
    engine.close()


if __name__ == "__main__":
    {"produce": produce, "consume": consume}[sys.argv[1]](*sys.argv[2:])
