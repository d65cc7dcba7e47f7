"""The host's operators on Spark Structured Streaming, for more traffic than one machine can process.

    process ─► file ─► split: (query, window, shard) ─► window of event time ─► the numpy operators ─► results
    of one     of one    on the workers                  Spark keeps what is     of one shard of one
    batch      batch                                     open, and when          window, on the workers
                                                         it is over

Replaces `HostEngine` and finds the same results, but at another time: they are reported when their window
has ended, even those that `HostEngine` reports at the crossing (their time is still that of the crossing).
A batch is on disk before the stream that it came by is acknowledged.  pyspark is an optional extra and
is imported when the first engine is made.
"""

import base64
import json
import logging
import os
import shutil
import sys
import tempfile
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Final

import msgspec

from apps.sonata_adapter.errors import SonataError
from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.host.engine import DEFAULT_LATENESS_US, DEFAULT_LIMIT, HostEngine
from apps.sonata_adapter.host.spark_pieces import pieces_of, results_of
from apps.sonata_adapter.query.dataflow import TupleStream, compile_query
from apps.sonata_adapter.query.language import Query
from apps.sonata_adapter.results import Captured, QueryResult
from due import RecordBatch
from due.codec import decode_value, encode_value

_HEARTBEAT: Final = ""
"""In place of a query: carries the current capture time."""
_PIECE: Final = "array<struct<query:string, shard:int, time:bigint, packets:binary>>"


class SparkMissing(SonataError):
    """pyspark cannot be imported, or does not find Java."""


class SparkFailed(SonataError):
    """A stream of Spark ended with an error."""


class SparkEngine:
    """`HostEngine` with Spark behind it; `master` as Spark writes it (`local[2]`, `spark://host:7077`)."""

    def __init__(
        self,
        *,
        limit: int = DEFAULT_LIMIT,
        lateness_us: int = DEFAULT_LATENESS_US,
        base_us: int = 0,
        master: str = "local[2]",
    ) -> None:
        self.watermark_us: int | None = None
        self.packets = 0
        self.late = 0
        self.without_payload = 0
        self._limit = limit
        self._lateness_us = lateness_us
        self._session = spark_session(master)
        self._folder = Path(tempfile.mkdtemp(prefix="sdnator-spark-"))
        self._queries: dict[str, tuple[Query, int | None]] = {}
        self._direct = HostEngine(limit=limit, lateness_us=lateness_us, base_us=base_us)
        self._streams: dict[int, _LengthStream] = {}
        self._base_us = base_us
        self._found: SimpleQueue[str] = SimpleQueue()

    @property
    def base_us(self) -> int:
        """Absolute time of the switch's clock zero, us; changing it restarts the streams."""
        return self._base_us

    @base_us.setter
    def base_us(self, base_us: int) -> None:
        if base_us == self._base_us:
            return
        self._base_us = self._direct.base_us = base_us
        for length in list(self._streams):
            self._streams.pop(length).stop()
            self._stream(length)

    @property
    def names(self) -> set[str]:
        """Queries in force."""
        return set(self._queries) | self._direct.names

    def add(self, query: Query) -> None:
        """Bring a query into force; packets as such go through without Spark."""
        if isinstance(compile_query(query), TupleStream):
            self._direct.add(query)
            return
        self._queries[query.name] = (query, self.watermark_us)
        if query.window_us not in self._streams:
            self._stream(query.window_us)

    def _stream(self, length_us: int) -> None:
        lateness = min(self._lateness_us, length_us // 4)
        self._streams[length_us] = _LengthStream(
            self._session, self._folder, length_us, self._base_us, lateness, self._limit, self._found
        )

    def remove(self, name: str) -> None:
        """Forget a query; what is open in its windows is not reported."""
        self._direct.remove(name)
        self._queries.pop(name, None)
        lengths = {query.window_us for query, _ in self._queries.values()}
        for length in self._streams.keys() - lengths:
            self._streams.pop(length).stop()

    def process(self, batch: RecordBatch, *, horizon_us: int | None = None) -> list[QueryResult | Captured]:
        """Pass the packets to Spark; returns the results since the last call."""
        if not len(batch):
            return self._results()
        self.packets += len(batch)
        newest = int(batch["time_us"].max())
        outputs = self._direct.process(batch, horizon_us=horizon_us)
        time_us = newest if horizon_us is None else min(newest, max(horizon_us, 0))
        self.watermark_us = max(newest, self.watermark_us or newest)
        data = encode_value(batch)
        for length, stream in self._streams.items():
            stream.put(time_us, data, [q for q, _ in self._queries.values() if q.window_us == length])
        return outputs + self._results()

    def advance(self, now_us: int) -> list[QueryResult | Captured]:
        """Capture time has come to `now_us`, though no packet may have."""
        self.watermark_us = max(now_us, self.watermark_us or now_us)
        for stream in self._streams.values():
            stream.pass_time(now_us)
        return self._direct.advance(now_us) + self._results()

    def set_back(self, now_us: int) -> list[QueryResult | Captured]:
        """The switch's clock was set back to `now_us`: close all windows, whose time it was not, and begin anew.

        Spark's time never goes back, so its streams are started again; that takes seconds.
        """
        found = self.finish()
        self._direct.set_back(now_us)
        self.watermark_us = now_us
        self._queries = {name: (query, now_us) for name, (query, _) in self._queries.items()}
        for length in list(self._streams):
            self._streams.pop(length).stop()
            self._stream(length)
        return found

    def finish(self) -> list[QueryResult | Captured]:
        """No more packets will come: close all windows and wait for their results."""
        for stream in self._streams.values():
            stream.drain(self.watermark_us or 0)
        return self._direct.finish() + self._results()

    def close(self) -> None:
        """Stop Spark's streams and remove their files; the session stays for other engines."""
        for stream in self._streams.values():
            stream.stop()
        self._streams.clear()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _results(self) -> list[QueryResult | Captured]:
        found: list[QueryResult | Captured] = []
        while True:
            try:
                result = msgspec.json.decode(self._found.get_nowait(), type=QueryResult)
            except Empty:
                return found
            if result.query in self._queries:
                since = self._queries[result.query][1]
                partial = since is not None and since > result.window_us
                found.append(msgspec.structs.replace(result, partial=partial))


class _LengthStream:
    """Spark's stream for the windows of one length; files come in, texts of results go out."""

    def __init__(
        self,
        session: Any,
        folder: Path,
        length_us: int,
        base_us: int,
        lateness_us: int,
        limit: int,
        found: "SimpleQueue[str]",
    ) -> None:
        self._length_us = length_us
        self._base_us = base_us
        self._lateness_us = lateness_us
        self._folder = folder / str(length_us)
        self._numbers = count(1)
        self._newest_us = 0
        for name in ("in", "new"):
            (self._folder / name).mkdir(parents=True)
        self._query = self._start(session, limit, found)

    def _start(self, session: Any, limit: int, found: "SimpleQueue[str]") -> Any:
        from pyspark.sql import functions as f

        length_us, base_us = self._length_us, self._base_us
        split = f.udf(lambda queries, data: split_batch(queries, data, length_us, base_us), _PIECE)
        run = f.udf(lambda query, pieces: run_window(query, pieces, base_us, limit), "array<string>")
        lines = session.readStream.schema("time bigint, queries array<string>, packets binary").json(
            str(self._folder / "in")
        )
        pieces = (
            lines.select("time", f.explode(split("queries", "packets")).alias("piece"))
            .select(
                f.timestamp_micros(f.coalesce("piece.time", "time")).alias("time"),
                "piece.query",
                "piece.shard",
                "piece.packets",
            )
            .withWatermark("time", f"{self._lateness_us} microseconds")
        )
        window = f.window(
            "time", f"{length_us} microseconds", startTime=f"{base_us % length_us} microseconds"
        )
        results = (
            pieces.groupBy(window, "query", "shard")
            .agg(f.collect_list("packets").alias("pieces"))
            .where(f.col("query") != _HEARTBEAT)
            .select(f.explode(run("query", "pieces")).alias("result"))
        )

        def take(rows: Any, _batch: int) -> None:
            for row in rows.collect():
                found.put(row.result)

        return (
            results.writeStream.foreachBatch(take)
            .option("checkpointLocation", str(self._folder / "checkpoint"))
            .outputMode("append")
            .start()
        )

    def put(self, time_us: int, data: bytes, queries: list[Query]) -> None:
        """A batch for these queries; it is on disk when this returns.  Raises `SparkFailed`."""
        if not self._query.isActive:
            raise SparkFailed(
                f"Spark's stream of {self._length_us} us windows ended: {self._query.exception()}"
            )
        self._newest_us = max(self._newest_us, time_us)
        line = {
            "time": time_us,
            "queries": [msgspec.json.encode(query).decode() for query in queries],
            "packets": base64.b64encode(data).decode(),
        }
        name = f"{next(self._numbers):012}.json"
        new = self._folder / "new" / name
        new.write_text(json.dumps(line) + "\n", encoding="utf-8")
        new.rename(self._folder / "in" / name)

    def pass_time(self, now_us: int) -> None:
        """Say that time has come to `now_us`, unless that was said a moment ago."""
        if now_us - self._newest_us >= self._length_us // 4:
            self.put(now_us, b"", [])

    def drain(self, now_us: int) -> None:
        """Close all windows, and wait until Spark has said what was in them."""
        beyond = now_us + 2 * self._length_us + self._lateness_us
        for turn in range(2):
            # the first moves the watermark, which counts from the batch behind it on
            self.put(beyond + turn, b"", [])
            self._query.processAllAvailable()

    def stop(self) -> None:
        self._query.stop()
        shutil.rmtree(self._folder, ignore_errors=True)


def split_batch(
    queries: list[str], data: bytes, length_us: int, base_us: int
) -> list[tuple[str, int, int | None, bytes]]:
    """On a worker: what each query's shards get of a batch, window by window, and how far time has come."""
    pieces: list[tuple[str, int, int | None, bytes]] = [(_HEARTBEAT, 0, None, b"")]
    if not queries:
        return pieces
    batch = decode_value(bytes(data))
    packets = PacketColumns(batch)
    windows = (batch["time_us"] - base_us) // length_us
    for text in queries:
        query = msgspec.json.decode(text, type=Query)
        pieces += [
            (text, piece.shard, piece.newest_us, encode_value(piece.packets))
            for piece in pieces_of(query, batch, packets, windows)
        ]
    return pieces


def run_window(text: str, pieces: list[bytes], base_us: int, limit: int) -> list[str]:
    """On a worker: results of one query in one window, for the keys of one shard."""
    query = msgspec.json.decode(text, type=Query)
    found = results_of(query, [decode_value(bytes(piece)) for piece in pieces], base_us, limit)
    return [msgspec.json.encode(each).decode() for each in found]


def require_spark() -> None:
    """Raises `SparkMissing` with what to do where pyspark or Java are missing; starts nothing."""
    if find_spec("pyspark") is None:
        raise SparkMissing("engine spark needs pyspark: pip install 'sdnator[spark]'")
    home = os.environ.get("JAVA_HOME")
    if shutil.which("java") is None and not (home and (Path(home) / "bin" / "java").exists()):
        raise SparkMissing(
            "engine spark needs Java 17 or later: install a JRE, and put its java on the PATH or set JAVA_HOME"
        )


def spark_session(master: str) -> Any:
    """Spark's session of this process; raises `SparkMissing`."""
    require_spark()
    from pyspark.errors import PySparkException
    from pyspark.sql import SparkSession

    # workers are to be what this process is; and a host name that nothing resolves costs minutes
    os.environ.setdefault("PYSPARK_PYTHON", sys.executable)
    os.environ.setdefault("SPARK_LOCAL_HOSTNAME", "localhost")
    builder = SparkSession.builder.master(master).appName("sdnator sonata_adapter")
    options = {
        "spark.ui.enabled": "false",
        "spark.driver.host": "127.0.0.1",
        "spark.driver.bindAddress": "127.0.0.1",
        "spark.sql.session.timeZone": "UTC",
        "spark.ui.showConsoleProgress": "false",
        # a plain function over bytes needs neither pandas nor pyarrow
        "spark.sql.execution.pythonUDF.arrow.enabled": "false",
    }
    for name, value in options.items():
        builder = builder.config(name, value)
    try:
        session = builder.getOrCreate()
    except (PySparkException, OSError) as error:
        raise SparkMissing(f"Spark does not start on {master}: {error}; check its address and Java") from None
    logging.getLogger("py4j").setLevel(logging.WARNING)
    # each partition keeps state of its own: as many as work at a time will do
    session.conf.set("spark.sql.shuffle.partitions", str(session.sparkContext.defaultParallelism))
    return session
