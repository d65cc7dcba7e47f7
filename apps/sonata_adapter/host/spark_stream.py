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
from typing import Any

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
from due.drivers.kafka_names import KafkaAddress

Take = Callable[[Sequence[tuple[str, QueryResult]]], None]
"""Gets the results of a batch, each with its switch; the batch counts as done when it returns."""


@dataclass(frozen=True, kw_only=True)
class KafkaPackets:
    """Where the packets and the switches' clocks are on Kafka."""

    address: KafkaAddress
    pattern: str
    """Key of the packets, without specs."""
    clocks: str
    """Key under which it is told how far the switches' times have come, without specs."""
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
        """The topic of the switches' times."""
        return self.address.topic(self.clocks, reliable=False)

    def options(self) -> dict[str, str]:
        """What Spark's source has to know about the brokers; certificates are read here."""
        address = self.address
        found = {
            "kafka.bootstrap.servers": address.servers,
            "kafka.group.id": address.group(self.group),
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
        raise InvalidRequest(f"{query.name} reports packets as they come, which needs no Spark")
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
        every_s: pause between the begins of two batches; 0: only what is there now, then the stream ends.
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
        self._read: dict[int, int] = {}
        self._counts = {"packets": 0, "refused": 0, "late": 0, "batches": 0}
        # the windows of two switches begin at different times, and may wait for each other so long
        shifts = [job.shift_us(switch) for switch in job.bases]
        patience_us = lateness_us + max(shifts) - min(shifts)
        results = _results(session, source, job, patience_us)
        trigger = {"processingTime": f"{every_s} seconds"} if every_s else {"availableNow": True}
        self._query = (
            results.writeStream.foreachBatch(partial(_hand_over, take))
            .option("checkpointLocation", checkpoint)
            .outputMode("append")
            .trigger(**trigger)
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

    def wait(self, timeout_s: float) -> bool:
        """Whether it has ended within this time."""
        return bool(self._query.awaitTermination(timeout_s))

    def counts(self) -> dict[str, int]:
        """Packets and refused frames that were read, rows that were too late, and batches."""
        for progress in self._query.recentProgress:
            if progress.batchId <= self._seen:
                continue
            self._seen = progress.batchId
            self._counts["batches"] += 1
            intake = progress.observedMetrics.get("intake")
            for name in ("packets", "refused") if intake is not None else ():
                self._counts[name] += intake[name] or 0
            self._counts["late"] += sum(each.numRowsDroppedByWatermark for each in progress.stateOperators)
        return dict(self._counts)

    def read(self) -> dict[int, int]:
        """Partition of the packets' topic to the offset up to which it was read and worked on."""
        for progress in self._query.recentProgress:
            for source in progress.sources:
                ends = json.loads(source.endOffset or "null")
                if isinstance(ends, dict) and self._topic in ends:
                    self._read = {int(place): int(offset) for place, offset in ends[self._topic].items()}
        return self._read

    def stop(self) -> None:
        """End it; what is open stays in the checkpoint."""
        self._query.stop()


def _results(session: Any, source: KafkaPackets, job: WindowJob, patience_us: int) -> Any:
    """The stream's plan."""
    from pyspark.sql import functions as f

    packets = _records(session, source, source.topic).option("maxOffsetsPerTrigger", source.at_once)
    # times are kept for a minute: what was deleted before it was read is no loss
    clocks = _records(session, source, source.clock_topic).option("failOnDataLoss", "false")
    columns = ("topic", "key", "value", "offset")
    records = packets.load().select(*columns).unionByName(clocks.load().select(*columns))
    rows = (
        records.mapInArrow(lambda batches: read_records(batches, job), ROWS)
        .observe("intake", f.sum("read").alias("packets"), f.sum("refused").alias("refused"))
        .where(f.col("time").isNotNull())
        .withColumn("time", f.timestamp_micros("time"))
        .withWatermark("time", f"{-(-patience_us // 1000)} milliseconds")
    )
    window = f.window("time", f"{job.length_us} microseconds")
    return (
        rows.groupBy(window, "switch", "query", "shard")
        .agg(f.collect_list(f.struct("offset", "packets")).alias("pieces"))
        .where(f.col("query") != NO_QUERY)
        .select("switch", "query", "pieces")
        .mapInArrow(lambda batches: run_windows(batches, job), RESULTS)
    )


def _records(session: Any, source: KafkaPackets, topic: str) -> Any:
    reader = session.readStream.format("kafka").options(**source.options())
    return reader.option("subscribe", topic).option("startingOffsets", "earliest")


def _hand_over(take: Take, rows: Any, _batch: int) -> None:
    take([(row.switch, msgspec.json.decode(row.result, type=QueryResult)) for row in rows.collect()])
