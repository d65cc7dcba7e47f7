"""The adapter among real processes, for benchmarks: declare keys, play frames, collect results."""

import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.query.catalogue import CATALOGUE
from benchmarks.sonata_traffic import FrameColumns
from due import Item
from sdnator.capture.interfaces import Feed, VethPair, WireFeed
from sdnator.testing.controller_run import BASE_US, PACKETS, ControllerRun, Heard, end
from sdnator.testing.oracles import sonata
from sdnator.testing.query_traffic import TimedFrame
from sdnator.testing.waiting import wait_for

PREFIX = "network.traffic_query.sonata"
QUERIES = {name: f"{PREFIX}.{name}" for name in CATALOGUE}
_BLOCK = 512
_BLOCK_S = 0.01
"""Frames that are sent together are not farther apart, so that a gap in a capture is a gap here."""
_IN_FLIGHT = 20_000
_PACE_S = 0.002


class SonataStage(ControllerRun):
    """Switch, controller, Coordinator and adapter; `with SonataStage(folder) as stage`.

    `kind`: embedded, or bmv2 behind a veth pair, which needs root and has a clock of its own.
    """

    base_us = BASE_US

    def __init__(self, folder: Path, kind: str = "embedded") -> None:
        self._cable = ExitStack()
        self._wire = VethPair.make(self._cable, "so") if kind == "bmv2" else None
        super().__init__(folder, kind=kind, veth=self._wire.far if self._wire is not None else "")

    def __enter__(self) -> Self:
        super().__enter__()
        self._adapter = self.run("apps.sonata_adapter.service", {"base_us": {"s1": BASE_US}})
        self._observer = self.engine("observer")
        self._states = Heard(self._observer, "network.switch.p4runtime_ctrl.s1")
        self._health = Heard(self._observer, "due.health.sonata_adapter")
        self._results: list[Item] = []
        self.controller()
        self._feed: Feed = self.feed() if self._wire is None else WireFeed(self._wire.near)
        self.tuples: dict[str, int] = {}
        self.overflow: dict[str, int] = {}
        self.late_reads = 0
        wait_for(lambda: self._states.values("network.switch"))
        return self

    def __exit__(self, *details: object) -> None:
        self._feed.close()
        super().__exit__(*details)
        self._cable.close()

    @property
    def _telemetry(self) -> list[str]:
        states = self._states.values("network.switch")
        return list(states[-1]["telemetry"]) if states else []

    def declare(self, keys: Iterable[str]) -> None:
        """Observe keys; returns when the switch has all that they need."""
        for key in keys:
            self._observer.observe(key).subscribe(self._results.append)
        wait_for(self._settled, 60, self.log)

    def _settled(self) -> bool:
        """The adapter's bits are those that the switch has."""
        health = self._health.values("health")
        bits = health[-1]["app"]["bits"] if health else 0
        return bool(bits) and len(self._telemetry) == bits

    def note_times(self) -> None:
        """From now on note when the switch took each frame; returns when it tells."""
        before = len(self._telemetry)
        self._noted = Heard(self._observer, PACKETS)
        wait_for(lambda: len(self._telemetry) > before, 30, self.log)

    def stamped(self, frames: Sequence[TimedFrame]) -> list[TimedFrame]:
        """The frames with the switch's times, after `note_times` and `play`; all must have been noted."""
        wait_for(lambda: len(self._noted.arrivals()) >= len(frames), 30, self.log)
        batches = [item.value for item in self._noted.items if item.key == PACKETS]
        times = np.concatenate([batch["time_us"] for batch in batches])
        order = np.argsort(self._noted.arrivals(), kind="stable")
        return [
            TimedFrame(time_us, frame.length, frame.data)
            for time_us, frame in zip(times[order].tolist(), frames, strict=True)
        ]

    def play(
        self, frames: Sequence[TimedFrame] | FrameColumns, *, faster: float = 0.0, zero: int | None = None
    ) -> int:
        """Send all frames; returns their number.

        `faster`: so many times as fast as they were captured, 0 = as fast as the switch takes them.
        `zero`: the switch's clock zero, default the first frame's second.
        """
        traffic = frames if isinstance(frames, FrameColumns) else FrameColumns.of(frames)
        sent = done = 0
        begin, first = time.monotonic(), int(traffic.times_us[0])
        times_us = traffic.times_us - (first // 10**6 * 10**6 if zero is None else zero)
        for part in blocks(np.maximum.accumulate(times_us), round(_BLOCK_S * faster * 1e6)):
            if faster:
                ahead = int(traffic.times_us[part][-1] - first) / 1e6 / faster - (time.monotonic() - begin)
                time.sleep(max(0.0, ahead))
            self._feed.send(times_us[part].tolist(), traffic.lengths[part].tolist(), traffic.data[part])
            size = part.stop - part.start
            sent += size
            done += size if self._wire is not None else len(self._feed.verdicts())
            while sent - done > _IN_FLIGHT:
                time.sleep(0.001)
                done += len(self._feed.verdicts())
        while done < sent:
            time.sleep(0.01)
            done += len(self._feed.verdicts())
        return sent

    def settle(self) -> dict[str, int]:
        """Wait until all is quiet; tuples that have reached the host, by query."""
        self._health.items.clear()
        wait_for(self._quiet, 120)
        last: Any = self._health.values("health")[-1]
        self.tuples = _by_name(last["app"]["tuples"])
        self.overflow = _by_name(last["app"]["overflow"])
        self._written = last["app"]["results"]
        self.late_reads = last["app"]["late_reads"]
        return dict(self.tuples)

    def finish(self) -> dict[str, list[dict[str, Any]]]:
        """Wait until all is quiet, end the adapter, and give the results by query."""
        self.settle()
        end(self._adapter)
        wait_for(lambda: len(self._results) >= self._written)
        time.sleep(1)
        results: dict[str, list[dict[str, Any]]] = {name: [] for name in CATALOGUE}
        for item in list(self._results):
            results[item.key.partition(":")[0].rpartition(".")[2]].append(dict(item.value))
        return results

    def _quiet(self) -> bool:
        values: Any = self._health.values("health")[-3:]
        counts = [(v["app"]["host_packets"], v["app"]["reports"], v["app"]["results"]) for v in values]
        return len(counts) == 3 and len(set(counts)) == 1

    @contextmanager
    def traffic(self, frames: Iterator[bytes]) -> Iterator[None]:
        """Frames on the wall clock, without end."""
        stop = threading.Event()
        self._sent = self._done = 0
        self._forwarded = 0
        self._zero = time.monotonic()

        def run() -> None:
            while not stop.wait(_PACE_S):
                part = list(islice(frames, 10))
                now = int((time.monotonic() - self._zero) * 1e6)
                self._feed.send([now] * len(part), [60] * len(part), part)
                self._sent += len(part)
                self._count()

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()

    def _count(self) -> None:
        verdicts = self._feed.verdicts()
        self._done += len(verdicts)
        self._forwarded += sum(verdict >> 1 & 1 for verdict in verdicts)

    def first_result(self, query: str) -> float:
        """Seconds from declaring a key to its first result."""
        found = threading.Event()
        begin = time.monotonic()
        subscription = self._observer.observe(f"{PREFIX}.{query}").subscribe(lambda _item: found.set())
        assert found.wait(30), self.log()
        took = time.monotonic() - begin
        subscription.dispose()
        wait_for(lambda: not self._telemetry, 30, self.log)
        return took

    def delay_after_window(self, query: str, results: int) -> list[float]:
        """Seconds from a window's end to its result, on the wall clock that `traffic` sends by."""
        took: list[float] = []

        def heard(item: Item) -> None:
            end_s = (item.value["window_end"] - self.base_us * 1000) / 1e9
            took.append(time.monotonic() - self._zero - end_s)

        subscription = self._observer.observe(f"{PREFIX}.{query}").subscribe(heard)
        wait_for(lambda: len(took) >= results, 60, self.log)
        subscription.dispose()
        wait_for(lambda: not self._telemetry, 30, self.log)
        return took[1:]

    def lost_while_changing(self, queries: Iterable[str]) -> int:
        """Frames that were not forwarded while queries were added, one by one, and removed."""
        before = self._sent, self._forwarded
        subscriptions = []
        for query in queries:
            subscriptions.append(self._observer.observe(f"{PREFIX}.{query}").subscribe(lambda _item: None))
            time.sleep(0.01)
        wait_for(self._settled, 240, self.log)
        for subscription in subscriptions:
            subscription.dispose()
            time.sleep(0.005)
        wait_for(lambda: not self._telemetry, 240, self.log)
        sent = self._sent
        wait_for(lambda: self._done >= sent, 60)
        return max(0, sent - before[0] - (self._forwarded - before[1]))


def _by_name(counts: dict[str, int]) -> dict[str, int]:
    """Counts by query instead of by its whole key."""
    found = {key.partition(":")[0].rpartition(".")[2]: n for key, n in counts.items()}
    return {name: found.get(name, 0) for name in CATALOGUE}


def blocks(times_us: NDArray[np.int64], span_us: int) -> Iterator[slice]:
    """Parts of a replay: at most `_BLOCK` frames, and none longer than `span_us`; 0: no matter how long.

    No time is before the one before it.
    """
    start = 0
    while start < len(times_us):
        part = times_us[start : start + _BLOCK]
        size = int(np.searchsorted(part, part[0] + span_us, "right")) if span_us else len(part)
        yield slice(start, start + size)
        start += size


def equal_to_naive(
    frames: Sequence[TimedFrame],
    results: dict[str, list[dict[str, Any]]],
    base_us: int,
    zero: int | None = None,
) -> list[str]:
    """Queries whose results differ from the naive evaluator's; `zero`: as of `SonataStage.play`."""
    return wrong_results(tuple(CATALOGUE), frames, results, base_us, zero)


def wrong_results(
    names: Iterable[str],
    frames: Sequence[TimedFrame],
    results: dict[str, list[dict[str, Any]]],
    base_us: int,
    zero: int | None = None,
) -> list[str]:
    """Those of some queries whose results differ from the naive evaluator's."""
    zero = frames[0].time_us // 10**6 * 10**6 if zero is None else zero
    packets = [sonata.read(frame.time_us - zero, frame.length, frame.data) for frame in frames]
    wrong = []
    for name in names:
        parameters = {each.name: each.default for each in CATALOGUE[name].parameters}
        truth = {(found.window, found.fields) for found in sonata.evaluate(name, packets, parameters)}
        length_ns = int(parameters["window"]) * 10**6
        mine = [_row(value, length_ns, base_us) for value in results[name]]
        if len(mine) != len(set(mine)) or set(mine) != truth:
            wrong.append(name)
    return wrong


def _row(value: dict[str, Any], length_ns: int, base_us: int) -> tuple[int, tuple[tuple[str, Any], ...]]:
    known = ("window_start", "window_end", "at", "exact", "partial", "error")
    fields = {name: found for name, found in value.items() if name not in known}
    return (value["window_start"] - base_us * 1000) // length_ns, tuple(sorted(fields.items()))
