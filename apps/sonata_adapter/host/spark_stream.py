"""Queries on Spark Structured Streaming that reads the packets from Kafka itself, on a cluster without a shared folder.

    Kafka ─► frames to pieces ─► windows of event time, with a watermark ─► the numpy operators ─► results
             on the workers      Spark keeps what is open in its checkpoint  on the workers        to the driver

One stream for each window length.  The workers need Python with SDNator, and a way to Kafka, the checkpoint (hdfs://,
s3a://, …) and the driver; the driver sends them the jars.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import msgspec

from apps.sonata_adapter.errors import InvalidRequest
from apps.sonata_adapter.host.spark import SparkFailed
from apps.sonata_adapter.host.spark_records import (
    NO_QUERY,
    RESULTS,
    ROWS,
    UnknownSwitch,
    WindowJob,
    read_records,
    run_windows,
)
from apps.sonata_adapter.query.dataflow import TupleStream, compile_query
from apps.sonata_adapter.query.language import Query
from apps.sonata_adapter.results import QueryResult
from due.drivers.base import own_group
from due.drivers.kafka_names import KafkaAddress

_NEWEST: Final = "newest_"
Take = Callable[[Sequence[tuple[str, QueryResult]]], None]
"""Gets the results of a batch, each with its switch; the batch counts as done when it returns."""


@dataclass(frozen=True, kw_only=True)
class KafkaPackets:
    """Where the packets and the switches' clocks are on Kafka."""

    address: KafkaAddress
    pattern: str
    """Key of the packets, without specs."""
    clocks: str
    """Key under which the time that all switches have passed is told, without specs."""
    group: str
    """App in whose name Kafka is read."""
    at_once: int = 4096
    """Most records of a batch."""

    @property
    def topic(self) -> str:
        """The topic of the packets."""
        return self.address.topic(self.pattern, reliable=True)

    @property
    def clock_topic(self) -> str:
        """The topic of that time."""
        return self.address.topic(self.clocks, reliable=False)

    def options(self) -> dict[str, str]:
        """What Spark's source has to know about the brokers; certificates are read here.

        Spark names a group for each start of a stream: workers keep consumers by group, and a task that failed may still
        read from one which a stream of the same group would take over, so that records would be missing there.
        """
        address = self.address
        found = {
            "kafka.bootstrap.servers": address.servers,
            "groupIdPrefix": address.group(own_group(self.group, "spark")),
            "kafka.security.protocol": ("SASL_" if address.user else "")
            + ("SSL" if address.tls else "PLAINTEXT"),
        }
        if address.user:
            module = (
                "scram.ScramLoginModule"
                if address.mechanism.startswith("SCRAM")
                else "plain.PlainLoginModule"
            )
            quoted = [text.replace("\\", "\\\\").replace('"', '\\"') for text in _user(address)]
            found["kafka.sasl.mechanism"] = address.mechanism
            found["kafka.sasl.jaas.config"] = (
                f"org.apache.kafka.common.security.{module} required "
                f'username="{quoted[0]}" password="{quoted[1]}";'
            )
        for path, store, name in (
            (address.ssl_ca_certs, "truststore", "certificates"),
            (address.ssl_certfile, "keystore", "certificate.chain"),
            (address.ssl_keyfile, "keystore", "key"),
        ):
            if path:
                found[f"kafka.ssl.{store}.type"] = "PEM"
                found[f"kafka.ssl.{store}.{name}"] = Path(path).read_text(encoding="ascii")
        return found


def _user(address: KafkaAddress) -> tuple[str, str]:
    return address.user, address.password


def streamed(query: Query) -> Query:
    """The query, if Spark can run it by windows.

    Raises:
        InvalidRequest: it reports packets as they come.
    """
    if isinstance(compile_query(query), TupleStream):
        raise InvalidRequest(
            f"{query.name} reports packets as they come, which Spark cannot: leave it to the Sonata adapter"
        )
    return query


class KafkaWindows:
    """One running stream: queries of one window length.

    Args:
        session: of Spark, with the jars of `spark-sql-kafka`.
        source: where the packets are.
        job: what the workers do.
        lateness_us: how long after its end a window waits for late packets.
        checkpoint: folder of Spark's state, reached by driver and workers alike.
        take: gets the results.
        every_s: pause between the begins of two batches.
    """

    def __init__(
        self,
        session: Any,
        source: KafkaPackets,
        job: WindowJob,
        *,
        lateness_us: int,
        checkpoint: str,
        take: Take,
        every_s: float,
    ) -> None:
        self.length_us = job.length_us
        self._seen = -1
        self._topic = source.topic
        self._job = job
        self._read: dict[int, int] = {}
        self._newest: dict[str, int] = {}
        self._counts = {"packets": 0, "refused": 0, "late": 0, "batches": 0}
        self._query = (
            _results(session, source, job, lateness_us)
            .writeStream.foreachBatch(partial(_hand_over, take))
            .option("checkpointLocation", checkpoint)
            .outputMode("append")
            .trigger(processingTime=f"{every_s} seconds")
            .start()
        )

    @property
    def active(self) -> bool:
        """Whether it runs."""
        return bool(self._query.isActive)

    def check(self) -> None:
        """Say why it ended.

        Raises:
            UnknownSwitch: there are packets of a switch that was unknown when it began.
            SparkFailed: anything else.
        """
        error = self._query.exception()
        if error is None:
            return
        text = str(error)
        if UnknownSwitch.__name__ in text:
            raise UnknownSwitch(text.partition(f"{UnknownSwitch.__name__}: ")[2].partition("\n")[0])
        raise SparkFailed(f"Spark's stream of {self.length_us} us windows ended: {text[:2000]}")

    def counts(self) -> dict[str, int]:
        """Packets and refused frames that were read, rows that were too late, and batches."""
        self._follow()
        return dict(self._counts)

    def read(self) -> tuple[dict[int, int], dict[str, int]]:
        """What was read and worked on.

        Returns:
            Partition of the packets' topic to the offset up to which it was; switch to the capture time of its newest
            packet, us.
        """
        self._follow()
        return self._read, self._newest

    def _follow(self) -> None:
        """Take in what Spark says of batches that have ended since the last call."""
        for progress in self._query.recentProgress:
            if progress.batchId <= self._seen:
                continue
            self._seen = progress.batchId
            self._counts["batches"] += 1
            self._counts["late"] += sum(each.numRowsDroppedByWatermark for each in progress.stateOperators)
            intake = progress.observedMetrics.get("intake")
            if intake is not None:
                self._take_in(intake.asDict())
            for source in progress.sources:
                ends = json.loads(source.endOffset or "null")
                if isinstance(ends, dict) and self._topic in ends:
                    self._read = {int(place): int(offset) for place, offset in ends[self._topic].items()}

    def _take_in(self, intake: dict[str, int | None]) -> None:
        for name in ("packets", "refused"):
            self._counts[name] += intake[name] or 0
        for number, switch in enumerate(self._job.bases):
            shifted = intake[f"{_NEWEST}{number}"]
            if shifted is not None:
                newest = shifted + self._job.shift_us(switch)
                self._newest[switch] = max(newest, self._newest.get(switch, 0))

    def stop(self) -> None:
        """End it; what is open stays in the checkpoint."""
        self._query.stop()


def _results(session: Any, source: KafkaPackets, job: WindowJob, lateness_us: int) -> Any:
    """The stream's plan; its watermark is that of the clocks alone."""
    from pyspark.sql import functions as f

    packets = _records(session, source, source.topic).options(
        startingOffsets="earliest", maxOffsetsPerTrigger=source.at_once
    )
    # what another driver told is not of these packets; what was deleted before it was read is told again
    clocks = _records(session, source, source.clock_topic).options(
        startingOffsets="latest", failOnDataLoss="false"
    )
    newest = [
        f.max(f.when(f.col("switch") == switch, f.col("time"))).alias(f"{_NEWEST}{number}")
        for number, switch in enumerate(job.bases)
    ]
    pieces = (
        _rows(packets, job)
        .observe("intake", f.sum("read").alias("packets"), f.sum("refused").alias("refused"), *newest)
        .where(f.col("query") != NO_QUERY)
        .withColumn("time", f.timestamp_micros("time"))
    )
    times = (
        _rows(clocks, job)
        .where(f.col("time").isNotNull())
        .withColumn("time", f.timestamp_micros("time"))
        .withWatermark("time", f"{-(-lateness_us // 1000)} milliseconds")
    )
    window = f.window("time", f"{job.length_us} microseconds")
    return (
        times.unionByName(pieces)
        .groupBy(window, "switch", "query", "shard")
        .agg(f.collect_list(f.struct("offset", "packets")).alias("pieces"))
        .select("switch", "query", "pieces")
        .mapInArrow(lambda batches: run_windows(batches, job), RESULTS)
    )


def _rows(records: Any, job: WindowJob) -> Any:
    columns = ("topic", "key", "value", "offset")
    return records.load().select(*columns).mapInArrow(lambda batches: read_records(batches, job), ROWS)


def _records(session: Any, source: KafkaPackets, topic: str) -> Any:
    return session.readStream.format("kafka").options(**source.options()).option("subscribe", topic)


def _hand_over(take: Take, rows: Any, _batch: int) -> None:
    take([(row.switch, msgspec.json.decode(row.result, type=QueryResult)) for row in rows.collect()])
