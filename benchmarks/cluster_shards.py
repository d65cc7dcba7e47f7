"""`benchmarks.cluster`: Kitsune by switch, whose instances are killed and joined while packets of two switches come.

    undisturbed   one instance has both switches                    the scores to compare with
    each round    two instances; kill -9 of one, once while the detectors train and once while they score; a third
                  joins

`shard_scores_equal`: the largest difference between the scores of a packet, undisturbed and in all rounds; infinite
where a packet has no score.  After a kill the packets since the last checkpoint are scored once more
(`shard_scored_again`), and must have the same scores.  `shard_checkpoint_bytes` is the largest, `shard_checkpoints` how
many were archived, `shard_pause_ms_p50` the time from a kill to the next score of that instance's switch.
"""

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from apps.kitsune.service import SCORE
from apps.kitsune.sharded import CHECKPOINT
from benchmarks.faults_stage import ChildProgram
from due import (
    CONSUMER,
    NO_WAIT,
    PRODUCER,
    PUB_ONLY,
    Capability,
    Engine,
    Interest,
    Item,
    Options,
    RecordBatch,
)
from due.drivers.embedded_redis import EmbeddedServer
from sdnator.testing.packet_rows import blank

SWITCHES: Final = ("s1", "s2")
PACKETS_KEY: Final = "network.packets.p4runtime_ctrl.{}.all"
ROWS: Final = 100
BATCHES: Final = 60
"""Of each switch."""
KILLS: Final = (12, 32)
"""Batches before an instance is killed: in training, and afterwards."""
JOIN: Final = 44
SETTINGS: Final = {"fm_grace": 500, "ad_grace": 1_500, "calibration_packets": 300, "threshold": 0.2}
_ENGINE: Final = {"heartbeat": 0.2}
_BASE_US: Final = 1_600_000_000_000_000
_HOSTS: Final = 40
_WATCHDOG_S: Final = 240.0

Scores = dict[tuple[str, int], list[npt.NDArray[np.float64]]]
"""By switch and the arrival number of a batch's first packet: its scores, as often as they were written."""


Batches = Mapping[str, Sequence[RecordBatch]]
"""By switch."""


class ShardRound(NamedTuple):
    """What came of one stream."""

    scores: Scores
    pauses_ms: list[float]
    checkpoints: list[int]
    """Bytes of each."""


def traffic(switch: str, batches: int = BATCHES) -> Iterator[RecordBatch]:
    """Packets of a few hosts that talk to a few others; the same for the same switch.

    Args:
        switch: its name is the seed.
        batches: how many.
    """
    random = np.random.default_rng(list(switch.encode()))
    now = float(_BASE_US)
    for number in range(batches):
        times = now + np.cumsum(random.exponential(10_000.0, ROWS))
        now = float(times[-1])
        hosts = random.zipf(1.6, (2, ROWS)) % _HOSTS + 1
        tcp = random.random(ROWS) < 0.7
        source, target = random.choice([22, 80, 443, 50_000, 50_001], (2, ROWS))
        yield blank(
            ROWS,
            time_us=times.astype("i8"),
            arrival=np.arange(ROWS) + number * ROWS,
            port=hosts[0] % 4,
            length=random.choice([60, 590, 1_500], ROWS),
            eth_src=hosts[0] + 0x020000000000,
            eth_dst=hosts[1] + 0x020000000000,
            ip_version=np.full(ROWS, 4),
            ip_src_lo=hosts[0] + 0x0A000000,
            ip_dst_lo=hosts[1] + 0x0A000000,
            tcp_sport=np.where(tcp, source, -1),
            tcp_dport=np.where(tcp, target, -1),
            udp_sport=np.where(tcp, -1, source),
            udp_dport=np.where(tcp, -1, target),
            tcp_flags=np.where(tcp, random.choice([2, 16, 18, 24], ROWS), 0),
        )


class ShardStage:
    """A server, a Coordinator, the writer of two switches' packets and instances of Kitsune; a context manager.

    Args:
        folder: for archive and logs.
        checkpoint_s: seconds between two checkpoints.
    """

    def __init__(self, folder: Path, checkpoint_s: float = 1.0) -> None:
        self._folder = folder
        self._server = EmbeddedServer(folder / "updates")
        self._stack = ExitStack()
        self._started = 0
        self._archive = f"sqlite:///{folder}/archive.db"
        self._checkpoint_s = checkpoint_s
        self.scores: Scores = {}
        self.writers: dict[str, str] = {}
        """By switch the instance that wrote its newest score."""

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(self._server)
            options = ("--updates", self._server.url, "--archive", self._archive, "--log", "warning")
            (self._folder / "engine.json").write_text(json.dumps(_ENGINE))
            settings = {**SETTINGS, "instances": "sharded", "checkpoint_seconds": self._checkpoint_s}
            (self._folder / "settings.json").write_text(json.dumps(settings))
            self._options = (*options, "--engine", self._folder / "engine.json")
            self._stack = stack
            self._program("coordinator.service", *options)
            self._engine = Engine(Options(heartbeat=0.2, directory=str(self._folder)))
            self._engine.set_pubsub(self._server.url)
            self._engine.set_db(self._archive)
            self._engine.init(
                "p4runtime_ctrl",
                PRODUCER | CONSUMER,
                interests=(Interest(SCORE),),
                capabilities=(Capability("network.packets.p4runtime_ctrl.*.*", delivery="reliable"),),
            )
            stack.callback(self._engine.close)
            self._engine.observe(SCORE).subscribe(self._take)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def member(self) -> ChildProgram:
        """Start an instance; return when it is ready."""
        return self._program(
            "apps.kitsune.service", *self._options, "--settings", self._folder / "settings.json"
        )

    def write(self, batches: Batches, first: int, last: int) -> None:
        """Write batches first to last of each switch, at a pace that a busy machine keeps up with."""
        for number in range(first, last):
            for switch, each in batches.items():
                self._engine.write(PACKETS_KEY.format(switch), each[number], [PUB_ONLY, NO_WAIT])
            time.sleep(0.02)

    def wait_wanted(self) -> None:
        """Return when the packets of all switches are wanted."""
        self.wait(lambda: all(self._engine.wanted(PACKETS_KEY.format(switch)) for switch in SWITCHES))

    def wait_scored(self, batches: int) -> None:
        """Return when so many batches of each switch have scores."""
        wanted = {(switch, number * ROWS) for switch in SWITCHES for number in range(batches)}
        self.wait(lambda: wanted <= self.scores.keys())

    def wait(self, condition: Any) -> None:
        """Return when a condition holds; raises RuntimeError after some minutes."""
        deadline = time.monotonic() + _WATCHDOG_S
        while not condition():
            if time.monotonic() > deadline:
                raise RuntimeError(f"nothing more came: {len(self.scores)} batches have scores")
            time.sleep(0.01)

    def checkpoints(self) -> list[int]:
        """Bytes of the checkpoints in the archive."""
        return [
            item.value["state"]["length"]
            for switch in SWITCHES
            for item in self._engine.get(f"{CHECKPOINT}.{PACKETS_KEY.format(switch)}")
        ]

    def archived(self) -> Scores:
        """The scores in the archive, of which there may be more than have been received."""
        found: Scores = {}
        for item in self._engine.get(SCORE):
            _add(found, item)
        return found

    def _take(self, item: Item) -> None:
        _add(self.scores, item)
        self.writers[item.value["switch"]] = item.instance_id

    def _program(self, module: str, *options: object) -> ChildProgram:
        self._started += 1
        program = ChildProgram(self._folder / f"program{self._started}.jsonl", *options, module=module)
        self._stack.callback(program.kill)
        program.wait(lambda line: bool(line.get("ready")))
        return program


def _add(scores: Scores, item: Item) -> None:
    key = item.value["switch"], item.value["first_arrival"]
    scores.setdefault(key, []).append(item.value["score"])


def undisturbed(folder: Path, batches: Batches) -> Scores:
    """The scores where one instance has both switches and lives.

    Args:
        folder: an empty one.
        batches: of each switch.
    """
    with ShardStage(folder) as stage:
        stage.member()
        stage.wait_wanted()
        stage.write(batches, 0, BATCHES)
        stage.wait_scored(BATCHES)
        return stage.scores


def disturbed(folder: Path, batches: Batches) -> ShardRound:
    """The scores where an instance is killed in training and another one afterwards, and a third joins.

    Args:
        folder: an empty one.
        batches: of each switch.
    """
    pauses: list[float] = []
    with ShardStage(folder) as stage:
        members = [stage.member(), stage.member()]
        stage.wait_wanted()
        first = 0
        for kill in KILLS:
            stage.write(batches, first, kill)
            stage.wait_scored(kill)
            if kill == KILLS[0]:
                stage.wait(lambda: len(set(stage.writers.values())) == len(SWITCHES))
            before = dict(stage.writers)
            at = members.pop(0).kill()
            stage.write(batches, kill, kill + 4)
            stage.wait_scored(kill + 4)
            pauses += [1000 * (time.monotonic() - at)] if stage.writers != before else []
            first = kill + 4
            members.append(stage.member())
        stage.write(batches, first, JOIN)
        members.append(stage.member())
        stage.write(batches, JOIN, BATCHES)
        stage.wait_scored(BATCHES)
        checkpoints = stage.checkpoints()
        archived = stage.archived()
    for key, found in archived.items():
        stage.scores.setdefault(key, []).extend(found)
    return ShardRound(stage.scores, pauses, checkpoints)


def difference(scores: Scores, wanted: Scores) -> float:
    """The largest difference of any score from what it should be; infinite where one is missing.

    Args:
        scores: each as often as it was written.
        wanted: the undisturbed ones.
    """
    worst = 0.0
    for key, (right, *_) in wanted.items():
        for found in scores.get(key, []):
            same = np.array_equal(found, right, equal_nan=True)
            worst = max(worst, 0.0 if same else float(np.nan_to_num(np.abs(found - right), nan=np.inf).max()))
    return worst if wanted.keys() <= scores.keys() else float("inf")


def figures(rounds: int, scale: float, end: float) -> dict[str, Any]:
    """Differences, pauses and sizes.

    Args:
        rounds: how often instances are killed; at most.
        scale: of the rounds.
        end: no further round begins after this time (s, monotonic).
    """
    batches = {switch: list(traffic(switch)) for switch in SWITCHES}
    found: list[ShardRound] = []
    with tempfile.TemporaryDirectory(prefix="cluster-") as folder:
        wanted = undisturbed(_made(Path(folder) / "undisturbed"), batches)
        for number in range(max(1, round(scale * rounds))):
            if found and time.monotonic() > end:
                break
            found.append(disturbed(_made(Path(folder) / f"round{number}"), batches))
            worst = difference(found[-1].scores, wanted)
            print(f"shards: round {number}: scores differ by {worst:g}", file=sys.stderr, flush=True)
    pauses = [pause for one in found for pause in one.pauses_ms]
    sizes = [size for one in found for size in one.checkpoints]
    again = sum(len(each) - 2 for one in found for each in one.scores.values())  # one received, one archived
    return {
        "shard_scores_equal": max(difference(one.scores, wanted) for one in found),
        "shard_scored_again": again * ROWS // 2,
        "shard_rounds": len(found),
        "shard_pause_ms_p50": statistics.median(pauses) if pauses else None,
        "shard_checkpoint_bytes": max(sizes, default=0),
        "shard_checkpoints": len(sizes),
    }


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder
