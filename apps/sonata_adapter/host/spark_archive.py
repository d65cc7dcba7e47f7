"""A query over archived packets in Parquet on Spark, with the results of the host engine over the archive.  Does I/O.

    Parquet ─► when each window is closed ─► driver ─┐
         └──► pieces of windows, without late packets ◄┘ ─► sorted by window ─► the numpy operators ─► results

The workers need Python with SDNator, and the files under the paths that the driver gives them.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import msgspec

from apps.sonata_adapter.errors import InvalidRequest
from apps.sonata_adapter.host.archive_columns import CLOCK_SCHEMA, PACKET_SCHEMA, WRITTEN
from apps.sonata_adapter.host.engine import DEFAULT_LATENESS_US, DEFAULT_LIMIT
from apps.sonata_adapter.host.spark import SparkFailed
from apps.sonata_adapter.host.spark_archive_rows import (
    PIECES,
    RESULTS,
    ArchiveJob,
    run_groups,
    split_rows,
)
from apps.sonata_adapter.host.spark_late import CLOCKS, WindowClock, clock_rows, closings_of
from apps.sonata_adapter.query.language import Query
from apps.sonata_adapter.results import QueryResult

MOST_WINDOWS: Final = 4_000_000
"""Most windows of all switches together, since the driver keeps a few numbers for each."""
_PARTITION_PACKETS: Final = 2_000_000
_MOST_PARTITIONS: Final = 512
_ARROW: Final = {
    "spark.sql.execution.arrow.maxRecordsPerBatch": "16384",
    # a piece is up to two megabytes: so many records of them would be too many
    "spark.sql.execution.arrow.maxBytesPerBatch": str(32 << 20),
}


@dataclass(frozen=True, kw_only=True)
class ArchivedPackets:
    """Packets of an archive in Parquet."""

    files: Sequence[Path]
    begin_ns: int
    """Only what was written from then on."""
    end_ns: int
    """Only what was written before."""
    bases: Mapping[str, int]
    """Every switch among them to absolute time of its clock zero, µs."""


@dataclass(frozen=True, kw_only=True)
class ArchiveResults:
    """What a query found."""

    results: list[QueryResult]
    """In the order in which windows end; those of a window by their times."""
    packets: int
    late: int
    """Packets left out because they came after the result of their window."""


def run_archived(session: Any, packets: ArchivedPackets, query: Query) -> ArchiveResults:
    """Run a query that reports by windows.

    Args:
        session: of Spark.
        packets: in Parquet.
        query: not one that reports packets as they come.

    Raises:
        InvalidRequest: there are too many windows.
        SparkFailed: a worker does not reach the files, or anything else.
    """
    clock = WindowClock(
        length_us=query.window_us,
        lateness_us=min(DEFAULT_LATENESS_US, query.window_us // 4),
        bases=dict(packets.bases),
    )
    if not packets.files:
        return ArchiveResults(results=[], packets=0, late=0)
    with _arrow_batches(session), _failures():
        closings, starts = closings_of(_clock(session, packets, clock))
        if not starts:
            return ArchiveResults(results=[], packets=0, late=0)
        job = ArchiveJob(
            query=msgspec.json.encode(query).decode(),
            limit=DEFAULT_LIMIT,
            clock=clock,
            closings=closings,
        )
        count = sum(row.packets for row in starts.values())
        found, late = _results(session, packets, job, count)
    results = [
        msgspec.structs.replace(result, partial=starts[switch].time > result.window_us)
        for switch, result in found
    ]
    results.sort(key=lambda each: (each.window_us + each.length_us, each.at_us, str(each.fields)))
    return ArchiveResults(results=results, packets=count, late=late)


def _clock(session: Any, packets: ArchivedPackets, clock: WindowClock) -> Any:
    from pyspark.sql import functions as f

    least = (
        _read(session, packets, CLOCK_SCHEMA)
        .mapInArrow(lambda batches: clock_rows(batches, clock), CLOCKS)
        .groupBy("switch", "kind", "number")
        .agg(f.min(f.struct("item", "time")).alias("least"), f.sum("packets").alias("packets"))
        .select("switch", "kind", "number", "least.item", "least.time", "packets")
        .limit(2 * MOST_WINDOWS + 1)
        .toArrow()
    )
    if least.num_rows > 2 * MOST_WINDOWS:
        raise InvalidRequest(
            f"more than {MOST_WINDOWS:,} windows of {clock.length_us / 1e6:g} s: give a shorter period, or longer windows"
        )
    return least


def _results(
    session: Any, packets: ArchivedPackets, job: ArchiveJob, count: int
) -> tuple[list[tuple[str, QueryResult]], int]:
    partitions = min(
        max(count // _PARTITION_PACKETS, session.sparkContext.defaultParallelism), _MOST_PARTITIONS
    )
    group = ("switch", "number", "shard")
    rows = (
        _read(session, packets, PACKET_SCHEMA)
        .mapInArrow(lambda batches: split_rows(batches, job), PIECES)
        .repartition(partitions, *group)
        .sortWithinPartitions(*group, "row")
        .mapInArrow(lambda batches: run_groups(batches, job), RESULTS)
        .collect()
    )
    found = [(row.switch, msgspec.json.decode(row.result, type=QueryResult)) for row in rows if row.result]
    return found, sum(row.late for row in rows)


def _read(session: Any, packets: ArchivedPackets, schema: str) -> Any:
    from pyspark.sql import functions as f

    # the driver's default file system may be another one
    files = [f"file://{path}" for path in packets.files]
    written = f.col(WRITTEN)
    return (
        session.read.schema(schema)
        .parquet(*files)
        .where((written >= packets.begin_ns) & (written < packets.end_ns))
    )


@contextmanager
def _arrow_batches(session: Any) -> Iterator[None]:
    """Bounds what a worker holds at a time; the session may be one that others use, too."""
    before = {name: session.conf.get(name, None) for name in _ARROW}
    for name, value in _ARROW.items():
        session.conf.set(name, value)
    try:
        with warnings.catch_warnings():
            # of pandas we use nothing
            warnings.filterwarnings("ignore", "PySpark does not yet fully support pandas", FutureWarning)
            yield
    finally:
        for name, value in before.items():
            if value is None:
                session.conf.unset(name)
            else:
                session.conf.set(name, value)


@contextmanager
def _failures() -> Iterator[None]:
    from pyspark.errors import PySparkException

    lost: Any = import_module("py4j.protocol").Py4JError
    try:
        yield
    except (PySparkException, lost) as error:
        text = str(error)
        if "FileNotFoundException" in text or "FILE_NOT_EXIST" in text:
            raise SparkFailed(
                "a worker of Spark does not reach the exported files: give a folder (--parquet) that all machines "
                "have mounted at the same path, and that Spark's user may read"
            ) from None
        raise SparkFailed(f"Spark could not run the query: {' '.join(text.split())[:500]}") from None
