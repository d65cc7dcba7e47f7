"""Small apps that fault tests start as processes and kill: `python -m tests.due.faults.programs NAME URL ...`."""

import os
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import msgspec

from due import CONSUMER, NO_WAIT, PRODUCER, PUB_ONLY, Capability, Engine, Item, Options
from due.shard_archive import ArchivedStates
from due.shards import Place

KEY = "fault.stream"
SPEECH = "fault.speech.speaker"
LINKS = "fault.link"
CHAINS = "fault.chain"
OPTIONS = Options(coordinated=False, window_bytes=4 << 20, backlog_bytes=4 << 20)


def _engine(url: str, app: str, role=PRODUCER | CONSUMER, options=OPTIONS, **init) -> Engine:
    engine = Engine(options)
    engine.set_pubsub(url)
    engine.init(app, role, **init)
    return engine


def produce(
    url: str, delivery: str, count: str, size: str, window: str = str(4 << 20), patience: str = "30"
) -> None:
    """Write numbered payloads and say where we are, then that all is flushed; one more for each line we get."""
    engine = _engine(
        url,
        "maker",
        options=msgspec.structs.replace(
            OPTIONS, window_bytes=int(window), retain_bytes=4 * int(window), group_timeout=float(patience)
        ),
        capabilities=[Capability(KEY, delivery="reliable" if delivery == "reliable" else "best_effort")],
    )
    padding = b"." * int(size)
    for number in range(int(count)):
        engine.write(KEY, [number, padding], [PUB_ONLY])
        if number % 1000 == 999:
            print(number + 1, flush=True)
    engine.flush(120)
    print("flushed", engine.health()["updates"]["resent"], flush=True)
    for number, _ in enumerate(sys.stdin, int(count)):
        engine.write(KEY, [number, padding], [PUB_ONLY])
    engine.close()


def consume(url: str, app: str, count: str, delay_ms: str) -> None:
    """Print `sequence number` of every item, `missing N` on each gap, `gaps N` at the end after `count` items."""
    engine = _engine(url, app)
    left = [int(count)]
    delay = float(delay_ms) / 1000

    def callback(item) -> None:
        if delay:
            time.sleep(delay)
        sys.stdout.write(f"{item.sequence} {item.value[0]}\n")
        if delay:
            sys.stdout.flush()  # whatever is acknowledged has been said, also if we are killed now
        left[0] -= 1

    engine.observe(KEY).subscribe(callback)
    print("ready", flush=True)
    idle, before, missing = 0.0, left[0], 0
    while left[0] > 0 and idle < 60:
        time.sleep(0.05)
        idle = idle + 0.05 if before == left[0] else 0.0
        before = left[0]
        if engine.health()["receiving"]["gaps"] != missing:
            missing = engine.health()["receiving"]["gaps"]
            sys.stdout.write(f"missing {missing}\n")
        sys.stdout.flush()
    receiving = engine.health()["receiving"]
    print("gaps", receiving["gaps"], "repeats", receiving["repeats"], flush=True)
    engine.close()


def speak(url: str, name: str, heartbeat: str, handshake: str = "20") -> None:
    """One of several standby instances: writes its name and a number every 5 ms, says what came of it."""
    engine = Engine(Options(heartbeat=float(heartbeat), handshake_timeout=float(handshake)))
    engine.set_pubsub(url)
    engine.init("speaker", PRODUCER, capabilities=[Capability(SPEECH, delivery="reliable")])
    print("instance", engine.instance_id, flush=True)
    number, spoke = 0, None
    while True:
        written = engine.write(SPEECH, [name, number], [PUB_ONLY, NO_WAIT])
        number += written
        if written != spoke:
            spoke = written
            print("active" if written else "standby", time.time(), flush=True)
        time.sleep(0.005)


def listen(url: str) -> None:
    """Hear the speakers: `sequence name number epoch` of each item."""
    engine = Engine(Options(heartbeat=0.1))
    engine.set_pubsub(url)
    engine.init("listener", CONSUMER)
    engine.observe(SPEECH).subscribe(
        lambda item: print(time.time(), item.value[0], item.value[1], item.timestamp, flush=True)
    )
    print("ready", flush=True)
    sys.stdin.readline()


class Chain:
    """A state that tells whether every item counted once, and in order."""

    def __init__(self, engine: Engine) -> None:
        self._saved = ArchivedStates(engine, CHAINS)
        self._chains: dict[str, list[int]] = {}

    def load(self, path: str) -> Place | None:
        found = self._saved.load(path)
        self._chains[path] = found[0] if found else [0, 0]
        print("loaded", path, self._chains[path][0], flush=True)
        return found[1] if found else None

    def save(self, path: str, place: Place) -> None:
        self._saved.save(path, list(self._chains[path]), place)

    def drop(self, path: str) -> None:
        del self._chains[path]

    def take(self, item: Item) -> None:
        chain = self._chains[item.key]
        self._chains[item.key] = [chain[0] + 1, linked(chain[1], item.value)]


def linked(chain: int, number: int) -> int:
    """The chain with one more number."""
    return zlib.crc32(b"%d %d" % (chain, number))


def chain(url: str, folder: str) -> None:
    """One of several instances of a sharded app."""
    engine = Engine(Options(heartbeat=0.2, directory=folder, archive=f"sqlite:///{folder}/archive.db"))
    engine.set_pubsub(url)
    engine.init("chainer", instances="sharded")
    state = Chain(engine)
    engine.keep_state(state, every=0.5)
    engine.observe(f"{LINKS}.*").subscribe(state.take)
    print("ready", flush=True)
    sys.stdin.readline()
    engine.close()


def shift_clock(file: Path) -> None:
    """From now on this process' wall clock is off by as many seconds as the file says at the moment."""
    real = time.time_ns
    time.time_ns = lambda: real() + 10**9 * int(file.read_text() or 0)
    time.time = lambda: time.time_ns() / 1e9


if __name__ == "__main__":
    if "FAULT_CLOCK" in os.environ:
        shift_clock(Path(os.environ["FAULT_CLOCK"]))
    programs: dict[str, Callable[..., None]] = {
        "produce": produce,
        "consume": consume,
        "speak": speak,
        "listen": listen,
        "chain": chain,
    }
    programs[sys.argv[1]](*sys.argv[2:])
