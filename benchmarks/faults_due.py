"""What each fault of the data layer costs, in seconds and in messages; run by `python -m benchmarks.faults`."""

import json
import os
import signal
import threading
import time
import urllib.request
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

from benchmarks.faults_programs import KEY
from benchmarks.faults_stage import ArchiveServer, ChildProgram, FaultStage, Line, until
from due import DB_ONLY, Engine, Options

Figures = dict[str, float | int | bool]

MESSAGES = 200_000
AWAY_S = float(os.environ.get("FAULTS_AWAY_S", "20"))
"""How long the archive server is away."""


def redis_killed(folder: Path) -> Figures:
    """kill -9 of Data Updates during a reliable stream of 200,000 messages; started again after 0.3 s."""
    with FaultStage(folder) as stage:
        consumer = _consumer(stage, 0)
        producer = stage.start("produce", "reliable", 0, MESSAGES, 50)
        producer.wait(lambda line: line.get("written", 0) >= MESSAGES // 4)
        stage.server.kill()
        killed = time.monotonic()
        time.sleep(0.3)
        stage.server.start()
        flushed = producer.wait(lambda line: "flushed" in line)
        end = _received_all(consumer, MESSAGES)
    return {
        **_sums(end, MESSAGES),
        "longest_pause_s": end["longest_pause_s"],
        "flushed_s": flushed["at"] - killed,
    }


def producer_killed(folder: Path) -> Figures:
    """kill -9 of the producer after `flush`, and a new one at once: nothing that was flushed is lost."""
    count = 20_000
    with FaultStage(folder) as stage:
        consumer = _consumer(stage, 50)
        first = stage.start("produce", "reliable", 0, count, 50)
        first.wait(lambda line: "flushed" in line)
        killed = first.kill()
        stage.start("produce", "reliable", count, count, 50).wait(lambda line: "flushed" in line)
        end = _received_all(consumer, 2 * count)
    return {**_sums(end, 2 * count), "all_received_s": end["last"] - killed}


def consumer_killed(folder: Path) -> Figures:
    """kill -9 of the consumer in the middle; a new one goes on where it stopped."""
    count = 50_000
    with FaultStage(folder) as stage:
        first = _consumer(stage, 100)
        producer = stage.start("produce", "reliable", 0, count, 50)
        first.wait(lambda line: line.get("received", 0) > count // 10)
        killed = first.kill()
        before = max(line.get("received", 0) for line in first.lines())
        second = _consumer(stage, 0)
        resumed = second.wait(lambda line: line.get("received", 0) > 0)
        producer.wait(lambda line: "flushed" in line)
        end = _settled(second)
    # what the first one had is known only as of its last line, so its own count is a lower bound
    missing = max(0, count - before - end["numbers"])
    return {"sent": count, "lost": missing, "resumed_s": resumed["at"] - killed}


def coordinator_killed(folder: Path) -> Figures:
    """kill -9 of the Coordinator: data flows on; a new one knows all again."""
    with FaultStage(folder) as stage:
        coordinator = stage.coordinator()
        listener, pair = _speakers(stage, 0.5)
        _hears(listener, 100)
        coordinator.kill()
        time.sleep(2.0)
        meanwhile = len(_words(listener))
        began = time.monotonic()
        url = str(stage.coordinator().lines()[0]["http"])
        ready = time.monotonic()
        until(lambda: len(_known(url)) >= len(pair) + 1)
        knew = time.monotonic() - ready
        _hears(listener, meanwhile + 100)
        words = _words(listener)
    pauses = [after["at"] - before["at"] for before, after in pairwise(words)]
    speakers = {word["speaker"] for word in words}
    return {
        "knows_all_again_s": knew,
        "heartbeat_s": 0.5,
        "start_s": ready - began,
        "longest_pause_s": max(pauses),
        "active_instances": len(speakers),
    }


def instance_killed(folder: Path) -> Figures:
    """Failover from a killed active instance at 10 Hz heartbeats."""
    with FaultStage(folder) as stage:
        stage.coordinator()
        listener, pair = _speakers(stage, 0.1)
        active = _hears(listener, 100)[-1]["speaker"]
        killed = pair[active].kill()
        first = listener.wait(lambda line: line.get("speaker", active) != active)
    return {"failover_s": first["at"] - killed, "heartbeat_s": 0.1}


def instance_paused(folder: Path) -> Figures:
    """SIGSTOP of the active instance, SIGCONT after the failover: the old one must not speak again."""
    with FaultStage(folder) as stage:
        stage.coordinator()
        listener, pair = _speakers(stage, 0.1)
        active = _hears(listener, 100)[-1]["speaker"]
        pair[active].process.send_signal(signal.SIGSTOP)
        stopped = time.monotonic()
        first = listener.wait(lambda line: line.get("speaker", active) != active)
        pair[active].process.send_signal(signal.SIGCONT)
        _hears(listener, len(_words(listener)) + 300)
        words = _words(listener)
    late = sum(word["speaker"] == active for word in words if word["at"] > first["at"])
    return {"failover_s": first["at"] - stopped, "words_of_the_old_after_the_new": late, "heartbeat_s": 0.1}


def archive_away(folder: Path) -> Figures:
    """A MongoDB-speaking archive server (nx-27017) is away under load; frames wait on disk meanwhile."""
    server = ArchiveServer(folder)
    with FaultStage(folder) as stage:
        options = Options(
            updates=stage.server.url, archive=server.start(), directory=str(folder), coordinated=False
        )
        engine = Engine(options)
        engine.init("writer")
        load = _Load(engine)
        load.start()
        try:
            until(lambda: engine.health().get("archive", {}).get("archived", 0) > 100)
            server.stop()
            time.sleep(AWAY_S)
            server.start()
            back = time.monotonic()
            load.stop()
            until(lambda: engine.health()["archive"]["backlog"] == 0)
            drained = time.monotonic() - back
            spooled = engine.health()["archive"]["spooled"]
            found = [item.value for item in engine.get(KEY)]
        finally:
            load.stop()
            engine.close()
            server.stop()
    return {
        "away_s": AWAY_S,
        "sent": load.written,
        "lost": load.written - len(set(found)),
        "twice": len(found) - len(set(found)),
        "spooled": spooled,
        "drained_s": drained,
    }


class _Load(threading.Thread):
    """Writes numbers for the archive, about a thousand a second."""

    def __init__(self, engine: Engine) -> None:
        super().__init__(daemon=True)
        self.written = 0
        self._engine = engine
        self._ended = threading.Event()

    def run(self) -> None:
        while not self._ended.wait(0.001):
            self._engine.write(KEY, self.written, [DB_ONLY])
            self.written += 1

    def stop(self) -> None:
        self._ended.set()
        self.join()


def slow_consumer_reliable(folder: Path) -> Figures:
    """A consumer far slower than its producer: the producer is held back, and the server's memory bounded."""
    return _slow(folder, "reliable", 40_000, 100)


def slow_consumer_best_effort(folder: Path) -> Figures:
    """The same with best effort: gaps are reported."""
    return _slow(folder, "best_effort", 300_000, 100)


def _slow(folder: Path, delivery: str, count: int, delay_us: int) -> Figures:
    with FaultStage(folder) as stage:
        consumer = _consumer(stage, delay_us)
        producer = stage.start("produce", delivery, 0, count, 1000)
        peak = 0

        def flushed() -> bool:
            nonlocal peak
            peak = max(peak, stage.used_memory())
            return any("flushed" in line for line in producer.lines())

        until(flushed)
        held_back = producer.lines()[-1]["held_back"]
        _wait_for_silence(
            consumer
        )  # a reader that the server has dropped comes back: only then can it hear of its gap
        producer.tell()
        consumer.wait(lambda line: line.get("newest") == count)
        end = consumer.finish()
    return {
        "sent": count + 1,
        "received": end["numbers"],
        "gaps_reported": end["gaps"],
        "unaccounted": count + 1 - end["numbers"] - end["gaps"],
        "held_back": held_back,
        "peak_memory_mb": peak / 1e6,
    }


def _consumer(stage: FaultStage, delay_us: int) -> ChildProgram:
    program = stage.start("consume", delay_us)
    program.wait(lambda line: "ready" in line)
    return program


def _received_all(consumer: ChildProgram, count: int) -> dict[str, float]:
    until(lambda: any(line.get("received", 0) >= count for line in consumer.lines()))
    return consumer.finish()


def _settled(consumer: ChildProgram) -> dict[str, float]:
    _wait_for_silence(consumer)
    return consumer.finish()


def _wait_for_silence(consumer: ChildProgram) -> None:
    """Until nothing more has come for two seconds."""
    while time.monotonic() - consumer.lines()[-1]["at"] < 2.0:
        time.sleep(0.1)


def _sums(end: dict[str, float], sent: int) -> Figures:
    return {"sent": sent, "lost": sent - int(end["numbers"]), "again": int(end["again"])}


def _speakers(stage: FaultStage, heartbeat: float) -> tuple[ChildProgram, dict[str, ChildProgram]]:
    listener = stage.start("listen")
    listener.wait(lambda line: "ready" in line)
    programs = [stage.start("speak", heartbeat) for _ in range(2)]
    pair = {str(one.wait(lambda line: "instance" in line)["instance"]): one for one in programs}
    for one in programs:
        one.wait(lambda line: "active" in line)
    return listener, pair


def _words(listener: ChildProgram) -> list[Line]:
    return [line for line in listener.lines() if "word" in line]


def _hears(listener: ChildProgram, count: int) -> list[Line]:
    return until(lambda: words if len(words := _words(listener)) >= count else None)


def _known(url: str) -> set[str]:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(f"{url}/instances", timeout=10) as answer:
        return {one["instance_id"] for one in json.load(answer) if one["app_id"] in ("speaker", "listener")}


SCENARIOS: dict[str, Callable[[Path], Figures]] = {
    "redis_killed": redis_killed,
    "producer_killed": producer_killed,
    "consumer_killed": consumer_killed,
    "coordinator_killed": coordinator_killed,
    "instance_killed": instance_killed,
    "instance_paused": instance_paused,
    "archive_away": archive_away,
    "slow_consumer_reliable": slow_consumer_reliable,
    "slow_consumer_best_effort": slow_consumer_best_effort,
}
