"""Queries over captures or archived packets, with the operators of a live run.

    captured │ ArchivedPieces ─► (switch, clock zero, batch) ─► one `HostEngine` for each switch ─► outputs

Windows count from a switch's clock zero, as live.  For a capture that is the second of its first packet, for
the archive the value that the controller wrote to `network.switch.p4runtime_ctrl.<switch>`.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from apps.messages import MessageError
from apps.packets import read_frames
from apps.sonata_adapter.arrivals import data_in
from apps.sonata_adapter.host.archive_columns import switch_of
from apps.sonata_adapter.host.engine import HostEngine, WindowEngine
from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.results import Captured, QueryResult
from due import RecordBatch
from due.drivers.base import ArchiveDriver
from sdnator.archive_export.archive_items import archived_items
from sdnator.archive_export.export import PACKETS
from sdnator.capture.captures import Capture
from sdnator.errors import BadInput
from sdnator.northbound import open_existing
from sdnator.plurals import counted

_WIDTH = 256
_BATCH = 16_384
_STATES = "network.switch.p4runtime_ctrl"
_STATES_READ = 1_000


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
            if not len(piece.batch):
                continue
            engine = self._engines.get(piece.switch)
            if engine is None:
                engine = self._engines[piece.switch] = self._make(base_us=piece.base_us)
                if not piece.whole:
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
        bare = sum(engine.without_payload for engine in engines)
        notes = [count_notes(sum(e.packets for e in engines), sum(e.late for e in engines))]
        if bare:
            notes.append(f"{bare:,} packets without payload: the archive holds headers only; use --capture")
        return "; ".join(filter(None, notes))


def count_notes(packets: int, late: int) -> str:
    """Remarks on these numbers of packets read, and left out for being late; empty: none."""
    if not packets:
        return "no packets in that time; they are archived while somebody observes them"
    return f"{late:,} packets arrived after the result of their window" if late else ""


@dataclass(frozen=True, kw_only=True)
class FoundInPast:
    """What a query finds."""

    outputs: Iterable[QueryResult | Captured]
    notes: Callable[[], Iterable[str]]
    """Remarks for display, once all outputs were taken; empty ones say nothing."""


class Past(NamedTuple):
    """A period of an archive."""

    url: str
    begin: int
    """ns; what was written from then on."""
    end: int
    """ns; what was written before."""


def over_captures(request: QueryRequest, paths: list[Path], make: Callable[..., WindowEngine]) -> FoundInPast:
    """Run a query over captures, one after the other."""
    past = PastPackets(request, make)
    return FoundInPast(outputs=past.run(captured(paths)), notes=lambda: [past.notes])


def over_archive(request: QueryRequest, period: Past, make: Callable[..., WindowEngine]) -> FoundInPast:
    """Run a query over archived packets."""
    past, pieces = PastPackets(request, make), ArchivedPieces(period)
    return FoundInPast(outputs=past.run(pieces), notes=lambda: [past.notes, pieces.notes])


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


class ArchivedPieces:
    """Packets in the archive that were written within a period."""

    def __init__(self, period: Past) -> None:
        self._period = period
        self._refused = self._damaged = 0

    def __iter__(self) -> Iterator[Piece]:
        with closing(open_existing(self._period.url)) as archive:
            bases: dict[str, int] = {}
            for item in archived_items(archive, PACKETS, self._period.begin, self._period.end):
                try:
                    batch = data_in(item)
                except MessageError:
                    self._refused += 1
                    continue
                switch = switch_of(item.key)
                if switch not in bases:
                    bases[switch] = base_us(archive, switch)
                yield Piece(switch, bases[switch], batch, whole=False)
            self._damaged = archive.damaged

    @property
    def notes(self) -> str:
        """What was left out, for display; empty: nothing."""
        return loss_notes(self._refused, self._damaged)


def loss_notes(refused: int, damaged: int) -> str:
    """Remarks on items without packets, and rows that the archive could not read; empty: there are none."""
    notes = [f"{counted(refused, 'item')} left out: no packets in them"] if refused else []
    if damaged:
        notes.append(f"the archive could not read {counted(damaged, 'row')}")
    return "; ".join(notes)


def base_us(archive: ArchiveDriver, switch: str) -> int:
    """Clock zero of a switch, from its newest state; 0: there is none."""
    states = archive.find({"dataKey": f"{_STATES}.{switch}"}, limit=_STATES_READ)
    values = (item.value for item in reversed(states) if isinstance(item.value, dict))
    return next((int(value["base_us"]) for value in values if "base_us" in value), 0)


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
