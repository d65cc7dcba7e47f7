"""Queries over captures or archived packets, with the operators of a live run.

    captured │ archived ─► (switch, clock zero, batch) ─► one `HostEngine` for each switch ─► outputs

Windows count from a switch's clock zero, as live.  For a capture that is the second of its first packet, for
the archive the value that the controller wrote to `network.switch.p4runtime_ctrl.<switch>`.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from apps.packets import read_frames
from apps.sonata_adapter.host.engine import HostEngine, WindowEngine
from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.results import Captured, QueryResult
from due import Item, RecordBatch
from due.drivers.base import ArchiveDriver
from sdnator.capture.captures import Capture
from sdnator.errors import BadInput
from sdnator.northbound import open_existing
from sdnator.notation import duration_ns
from sdnator.plurals import counted

_WIDTH = 256
_BATCH = 16_384
_PACKETS = "network.packets.p4runtime_ctrl.*.all"
_STATES = "network.switch.p4runtime_ctrl.*"
_SLICE_NS = 60 * 10**9
"""Length of the pieces in which the archive is read, since an hour of packets may not fit into memory."""


class Piece(NamedTuple):
    """Packets of one switch."""

    switch: str
    base_us: int
    batch: RecordBatch
    whole: bool
    """Whether the stream begins with its first packet; if not, the first windows are incomplete."""


class PastPackets:
    """A query run over captured or archived packets."""

    def __init__(self, request: QueryRequest, engine: Callable[..., WindowEngine] = HostEngine) -> None:
        self._request = request
        self._make = engine
        self._engines: dict[str, WindowEngine] = {}

    def run(self, pieces: Iterable[Piece]) -> Iterator[QueryResult | Captured]:
        """Outputs in the order in which windows end."""
        for piece in pieces:
            engine = self._engines.get(piece.switch)
            if engine is None:
                engine = self._engines[piece.switch] = self._make(base_us=piece.base_us)
                if not piece.whole and len(piece.batch):
                    engine.watermark_us = int(piece.batch["time_us"][0])
                engine.add(self._request.query)
            yield from engine.process(piece.batch)
        for engine in self._engines.values():
            yield from engine.finish()
            engine.close()

    @property
    def notes(self) -> str:
        """Remarks on the results, for display; empty: none."""
        engines = self._engines.values()
        packets, late = sum(e.packets for e in engines), sum(e.late for e in engines)
        bare = sum(engine.without_payload for engine in engines)
        notes = [] if packets else ["no packets in that time; they are archived while somebody observes them"]
        if bare:
            notes.append(f"{bare:,} packets without payload: the archive holds headers only; use --capture")
        if late:
            notes.append(f"{late:,} packets arrived after the result of their window")
        return "; ".join(notes)


def engine_of(name: str, master: str) -> Callable[..., WindowEngine]:
    """Factory of engines by their name in options; raises `SparkMissing`."""
    if name == "numpy":
        return HostEngine
    if name != "spark":
        raise BadInput(f"--engine {name}: give numpy or spark")
    from apps.sonata_adapter.host.spark import SparkEngine, spark_session

    spark_session(master)
    return partial(SparkEngine, master=master)


def captured(paths: list[Path]) -> Iterator[Piece]:
    """Captures, one after the other; windows count from the second of the first packet, as in a replay."""
    base_us, number = None, 0
    for path in paths:
        with Capture(path) as capture:
            if base_us is None:
                base_us = capture.first_time_ns // 10**9 * 10**6
            frames = iter(capture)
            while part := list(islice(frames, _BATCH)):
                times_us = [frame[0] // 1000 for frame in part]
                batch = _batch(times_us, [frame[1] for frame in part], [frame[2] for frame in part], number)
                yield Piece("", base_us, batch, whole=True)
                number += len(part)


def _batch(times_us: list[int], lengths: list[int], frames: list[bytes], first: int) -> RecordBatch:
    cut = [frame[:_WIDTH] for frame in frames]
    numbers = np.arange(first, first + len(frames))
    batch = read_frames(
        cut,
        lengths=lengths,
        times_us=times_us,
        ports=np.ones(len(frames), dtype=np.uint16),
        sequence=numbers + 1,
        arrival=numbers,
    )
    sizes = np.array([len(frame) for frame in cut], dtype=np.uint16)
    return RecordBatch({**batch, "frame": np.array(cut, dtype=f"V{_WIDTH}"), "captured": sizes})


def archived(url: str, since: str) -> Iterator[Piece]:
    """Packets in the archive that were written within the last `since` (`30s`, `1h`)."""
    begin = time.time_ns() - duration_ns(since, "--since")
    with closing(open_existing(url)) as archive:
        bases: dict[str, int] = {}
        for item in _slices(archive, begin, time.time_ns()):
            switch = item.key.split(".")[3]
            if switch not in bases:
                bases[switch] = _base_us(archive, switch)
            yield Piece(switch, bases[switch], item.value, whole=False)


def _slices(archive: ArchiveDriver, begin: int, end: int) -> Iterator[Item]:
    while begin < end:
        until = min(begin + _SLICE_NS, end)
        yield from archive.find({"dataKey": _PACKETS, "timestamp": {"$gte": begin, "$lt": until}})
        begin = until


def _base_us(archive: ArchiveDriver, switch: str) -> int:
    """Clock zero of a switch, from its newest state."""
    states = archive.find({"dataKey": _STATES.replace("*", switch)})
    return next((int(item.value["base_us"]) for item in reversed(states) if "base_us" in item.value), 0)


def as_line(output: QueryResult | Captured) -> dict[str, Any]:
    """The result as a JSON object."""
    if isinstance(output, Captured):
        return {"packets": len(output.batch), "until": output.last_us * 1000}
    return {"query": output.query, **output.to_value()}


def as_text(output: QueryResult | Captured) -> str:
    """The result as one line of text."""
    if isinstance(output, Captured):
        return f"{counted(len(output.batch), 'packet')} until {_clock(output.last_us)}"
    fields = "  ".join(f"{name} {value}" for name, value in sorted(output.fields.items()))
    mark = "" if output.exact else f"  (estimate: {output.error})"
    return f"{_clock(output.at_us)}  {fields}{mark}"


def _clock(time_us: int) -> str:
    second, fraction = divmod(time_us, 10**6)
    return f"{time.strftime('%Y-%m-%d %H:%M:%S', time.gmtime(second))}.{fraction:06d}"
