"""Reports on benign traffic, and attacks found, at `threshold=auto`: the host's operators alone, on capture time.

Each query learns from the first 12,001 of 38,363 real benign packets, as the firewall's evidence does; what it reports
of the rest is a false report.  The attacks are those of `benchmarks.sonata`, one of each kind in every 20 s; the queries
learn from an hour of the same office without attacks: as long as they do where nobody says how long training is.
"""

import random
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from apps.evidence import TrainingState
from apps.sonata_adapter.control import Control, Written
from apps.sonata_adapter.evidence.auto_thresholds import AutoThresholds
from apps.sonata_adapter.keys import QUERY_PREFIX
from apps.sonata_adapter.planner.placement import SwitchLimits
from apps.sonata_adapter.query.catalogue import CATALOGUE, PAPER
from apps.sonata_adapter.results import QueryResult
from benchmarks.data_folder import data_file
from benchmarks.sonata_evidence import TRAINING, batches_of
from due import RecordBatch
from sdnator.datasets.rebuild import rebuild
from sdnator.testing.query_traffic import BASE_US, HOSTS, TimedFrame, attack, batch_of, batches, office

LEARNT_S: Final = 3_600
ROUNDS: Final = 12
_ROUND_US: Final = 90_000_000
"""From one attack of a query to the next: two of them never share a window of a minute."""
_SWITCH: Final = "s1"
_BATCH: Final = 1024


class AutoRun:
    """The paper's queries at `threshold=auto`, fed with packets; every packet is copied."""

    def __init__(self, names: Sequence[str] = PAPER) -> None:
        # with one bit, every packet is copied; the operators filter them
        self._control = Control(CATALOGUE, limits=SwitchLimits(bits=1, stages=0))
        self._queries = AutoThresholds()
        refused = self._queries.want([f"{QUERY_PREFIX}.{name}:threshold=auto" for name in names], CATALOGUE)
        assert not refused, refused
        self._running = self._queries.requests
        self._control.want((), self._running)
        self._time = 0.0
        self.reports: list[tuple[str, QueryResult]] = []
        """Name of the query, and what it reported."""

    def feed(self, batch: RecordBatch, base_us: int = 0) -> None:
        """Packets in the order of time."""
        self._control.switch(_SWITCH, base_us)
        self._time += 1
        self._take(self._control.packets(_SWITCH, "q0", batch, self._time))
        self._note(self._queries.hear(int(batch["time_us"][-1])))
        self._follow()

    def trained(self, begin_us: int, now_us: int, *, done: bool) -> None:
        """How far the network's training is."""
        state = TrainingState(
            packets=1,
            wanted=1,
            done=done,
            seconds=(now_us - begin_us) / 1e6,
            senders=0,
            event_time=now_us * 1000,
        )
        self._note(self._queries.train("kitsune", state))
        self._follow()

    def end(self) -> None:
        """No more packets will come."""
        self._take(self._control.finish())

    def thresholds(self) -> dict[str, str]:
        """By name of the query."""
        found = self._queries.health().items()
        return {key.partition(":")[0].rpartition(".")[2]: text for key, text in found}

    def _take(self, written: Iterable[Written]) -> None:
        results = [(key, one.switch, one.output) for one in written for key in one.keys]
        self._note(
            self._queries.take((k, s, each) for k, s, each in results if isinstance(each, QueryResult))
        )

    def _note(self, found: Iterable[tuple[str, QueryResult]]) -> None:
        self.reports += [(key.partition(":")[0].rpartition(".")[2], result) for key, result in found]

    def _follow(self) -> None:
        if self._queries.requests != self._running:
            self._running = self._queries.requests
            self._control.want((), self._running)


def benign_figures(data: Path) -> dict[str, Any]:
    """Reports on the real benign capture at `threshold=auto` and at the defaults."""
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "benign.pcap"
        rebuild(data_file(data, "kitsune/mirai_38k.tsv.gz"), capture)
        run, seen, begin_us = AutoRun(), 0, 0
        for base_us, batch in batches_of(capture):
            run.feed(batch, base_us)
            seen += len(batch)
            begin_us = begin_us or int(batch["time_us"][0])
            if seen <= TRAINING:
                run.trained(begin_us, int(batch["time_us"][-1]), done=seen == TRAINING)
        run.end()
        defaults = _defaults(capture)
    counts = dict.fromkeys(PAPER, 0)
    for name, _ in run.reports:
        counts[name] += 1
    return {
        "benign_reports": counts,
        "benign_reports_at_defaults": defaults,
        "benign_thresholds": run.thresholds(),
    }


def _defaults(capture: Path) -> dict[str, int]:
    control = Control(CATALOGUE, limits=SwitchLimits(bits=1, stages=0))
    counts = dict.fromkeys(PAPER, 0)
    control.want([f"{QUERY_PREFIX}.{name}" for name in PAPER])
    written: list[Written] = []
    for number, (base_us, batch) in enumerate(batches_of(capture)):
        control.switch(_SWITCH, base_us)
        written += control.packets(_SWITCH, "q0", batch, float(number))
    for one in [*written, *control.finish()]:
        for key in one.keys:
            counts[key.partition(":")[0].rpartition(".")[2]] += 1
    return counts


def recall_figures() -> dict[str, Any]:
    """Attacks that each query finds at `threshold=auto`, of `ROUNDS`."""
    run = AutoRun()
    begin_us = BASE_US - LEARNT_S * 10**6
    quiet = office(LEARNT_S, random.Random(11), long=True)
    learnt = [frame._replace(time_us=frame.time_us - LEARNT_S * 10**6) for frame in quiet]
    for batch in batches(learnt):
        run.feed(batch)
        run.trained(begin_us, int(batch["time_us"][-1]), done=False)
    run.trained(begin_us, BASE_US, done=True)
    rng = random.Random(12)
    frames: list[TimedFrame] = office(ROUNDS * _ROUND_US // 10**6, rng, long=True)
    for number in range(ROUNDS):
        for place, name in enumerate(PAPER):
            frames += attack(name, BASE_US + number * _ROUND_US + 1_000_000 + place * 6_000_000, rng)
    frames.sort(key=lambda frame: frame.time_us)
    for begin in range(0, len(frames), _BATCH):
        run.feed(batch_of(frames[begin : begin + _BATCH], len(learnt) + begin))
    run.end()
    rounds: dict[str, set[int]] = {name: set() for name in PAPER}
    for name, result in run.reports:
        if HOSTS[name] in {result.fields.get(part) for part in ("src", "dst", "mac")}:
            rounds[name].add((result.at_us - 1 - BASE_US) // _ROUND_US)
    return {
        "auto_recall": {name: round(len(found) / ROUNDS, 3) for name, found in rounds.items()},
        "auto_recall_thresholds": run.thresholds(),
        "auto_others_reported": _others(run.reports),
    }


def _others(reports: Iterable[tuple[str, QueryResult]]) -> dict[str, int]:
    """Reports of hosts that no attack of any kind was aimed at."""
    known, counts = set(HOSTS.values()), dict.fromkeys(PAPER, 0)
    for name, result in reports:
        if not known & {result.fields.get(part) for part in ("src", "dst", "mac")}:
            counts[name] += 1
    return counts
