"""Small apps that `benchmarks.faults_due` starts and kills: `python -m benchmarks.faults_programs NAME URL ...`.

Each prints JSON lines; times are `time.monotonic()`, which all processes of a machine share.
"""

import json
import sys
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from due import CONSUMER, NO_WAIT, PRODUCER, PUB_ONLY, Capability, Engine, Item, Options

KEY = "fault.stream.maker.item"
SPEECH = "fault.speech.speaker.word"


def say(**fields: Any) -> None:
    """One JSON line."""
    print(json.dumps({"at": time.monotonic(), **fields}), flush=True)


def _engine(url: str, app: str, role: Any, **init: Any) -> Engine:
    engine = Engine(Options(coordinated=False, window_bytes=4 << 20))
    engine.set_pubsub(url)
    engine.init(app, role, **init)
    return engine


def produce(url: str, delivery: str, first: str, count: str, size: str) -> None:
    """Write numbered payloads, then flush; reports every thousand.  When told to, one more."""
    kind = Capability(KEY, delivery="reliable" if delivery == "reliable" else "best_effort")
    engine = _engine(url, "maker", PRODUCER, capabilities=[kind])
    padding = b"." * int(size)
    for number in range(int(first), int(first) + int(count)):
        engine.write(KEY, [number, padding], [PUB_ONLY])
        if number % 1000 == 999:
            say(written=number + 1)
    engine.flush(240)
    updates = engine.health()["updates"]
    say(flushed=True, resent=updates["resent"], held_back=updates["held_back"])
    sys.stdin.readline()
    engine.write(KEY, [int(first) + int(count), padding], [PUB_ONLY])
    engine.close()


def consume(url: str, delay_us: str) -> None:
    """Count numbers until told to stop; then what came, what is missing, and the longest pause."""
    engine = _engine(url, "reader", CONSUMER)
    seen: Counter[int] = Counter()
    delay = float(delay_us) / 1e6
    state = {"last": 0.0, "pause": 0.0}
    newest = [-1]

    def callback(item: Item) -> None:
        now = time.monotonic()
        if state["last"]:
            state["pause"] = max(state["pause"], now - state["last"])
        state["last"] = now
        seen[item.value[0]] += 1
        newest[0] = item.value[0]
        if delay:
            time.sleep(delay)

    engine.observe(KEY).subscribe(callback)
    say(ready=True)
    told = -1
    while not _asked_to_stop():
        if len(seen) != told:
            told = len(seen)
            say(received=told, newest=newest[0])
    receiving = engine.health()["receiving"]
    say(
        numbers=len(seen),
        again=sum(seen.values()) - len(seen),
        longest_pause_s=state["pause"],
        last=state["last"],
        gaps=receiving["gaps"],
    )
    engine.close()


def speak(url: str, heartbeat: str) -> None:
    """A standby instance: writes a number every 5 ms, says when it begins and ends to be the active one."""
    engine = Engine(Options(heartbeat=float(heartbeat), handshake_timeout=10.0))
    engine.set_pubsub(url)
    engine.init("speaker", PRODUCER, capabilities=[Capability(SPEECH, delivery="reliable")])
    say(instance=engine.instance_id)
    number, spoke = 0, None
    while True:
        written = engine.write(SPEECH, number, [PUB_ONLY, NO_WAIT])
        number += written
        if written != spoke:
            spoke = written
            say(active=written)
        time.sleep(0.005)


def listen(url: str) -> None:
    """Hear the speakers: one line for each word."""
    engine = Engine(Options(heartbeat=0.1))
    engine.set_pubsub(url)
    engine.init("listener", CONSUMER)
    engine.observe(SPEECH).subscribe(lambda item: say(speaker=item.instance_id, word=item.value))
    say(ready=True)
    sys.stdin.readline()


def _asked_to_stop() -> bool:
    import select

    ready, _, _ = select.select([sys.stdin], [], [], 0.05)
    return bool(ready)


if __name__ == "__main__":
    programs: dict[str, Callable[..., None]] = {
        "produce": produce,
        "consume": consume,
        "speak": speak,
        "listen": listen,
    }
    programs[sys.argv[1]](*sys.argv[2:])
