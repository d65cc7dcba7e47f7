"""Queries on Spark as a DUE app: the packets go from Kafka to Spark's workers, results come back to DUE.  Does I/O.

    packets on Kafka ─► Spark Structured Streaming ─► network.traffic_query.sonata_spark.<query>
    states of the switches, packets read ─► network.reached.sonata_spark: the time that all switches have passed

Nothing of the packets goes through this process.  Spark's checkpoint says how far Kafka was read: after a restart the
streams go on where they were; the results of the last batch may then come twice.
"""

import logging
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any, Final

import msgspec

import due.service
from apps.intake import Intake
from apps.messages import LATEST_NS, MessageError, read_latest, sender_of
from apps.sonata_adapter.arrivals import SwitchPrograms, data_in, state_in
from apps.sonata_adapter.errors import InvalidRequest, SonataError
from apps.sonata_adapter.host.engine import DEFAULT_LATENESS_US, DEFAULT_LIMIT
from apps.sonata_adapter.host.slowest_switch import SlowestSwitch
from apps.sonata_adapter.host.spark_clock import ReadClock
from apps.sonata_adapter.host.spark_jars import kafka_connector_jars
from apps.sonata_adapter.host.spark_place import MASTER, SparkPlace, cluster_session, way_to
from apps.sonata_adapter.host.spark_records import UnknownSwitch, WindowJob
from apps.sonata_adapter.host.spark_stream import KafkaPackets, KafkaWindows, streamed
from apps.sonata_adapter.keys import QUERY_PREFIX, QueryRequest, request_of
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.results import QueryResult
from due import NO_WAIT, PUB_ONLY, Capability, Engine, Interest, Item, Key
from due.drivers.kafka_names import SCHEMES, KafkaAddress, parse_kafka_url
from due.errors import InvalidOption

APP: Final = "sonata_spark"
SWITCHES: Final = "network.switch.p4runtime_ctrl.*"
PACKETS: Final = "network.packets.p4runtime_ctrl.*.all"
RESULTS: Final = f"network.traffic_query.{APP}"
REACHED: Final = f"network.reached.{APP}"
"""Capture time up to which Spark has read the packets of all switches; undeclared, because Spark alone reads it."""
_PARAMETERS: Final = sorted({each.name for template in CATALOGUE.values() for each in template.parameters})

INTERESTS = (Interest(SWITCHES), Interest(PACKETS))
CAPABILITIES = (
    Capability(
        f"{RESULTS}.*:{','.join(f'{name}=*' for name in _PARAMETERS)}", delivery="reliable", archive="always"
    ),
)

_LOG = logging.getLogger(__name__)
_STATES_READ: Final = 2_000
_FLUSH_S: Final = 60.0
_AGAIN_S: Final = 2.0
_CLOCK_S: Final = 0.5
_SETTLE_S: Final = 2.0
"""After the first state of a switch: a stream that begins without another one has to begin again for it."""
_MOST_FAILURES: Final = 5
"""In a row, without a batch between them."""
_SEGMENTS: Final = 5
"""Of a key of packets: kind, app, switch, query."""


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the queries on Spark."""

    queries: tuple[str, ...] = ()
    """What runs, as `syn_flood:window=2s` or as a whole key."""
    packets: str = PACKETS
    """Key of the packets, or of frames with payload: `network.frames.p4runtime_ctrl.*.all`."""
    keys: int = DEFAULT_LIMIT
    """Keys that one operator keeps exactly in a window; beyond that, results are marked as estimates."""
    lateness_us: int = DEFAULT_LATENESS_US
    """How long after its end a window waits for late packets, us."""
    spark_master: str = "local[2]"
    """Where Spark runs: `local[N]`, `spark://host:7077`."""
    driver_host: str = ""
    """Address at which the workers reach this machine; empty: the one that leads to the master."""
    checkpoint: str = ""
    """Where Spark keeps its state, reached by all machines: `hdfs://…`, `s3a://…`, `file:///mounted/…`; empty, on
    one machine only: in the engine's folder."""
    jars: str = ""
    """Folder with the jars of spark-sql-kafka; empty: Maven copies them once."""
    python: str = sys.executable
    """Python with SDNator on the workers."""
    every_s: float = 1.0
    """Seconds between the begins of two batches."""
    idle_s: float = 10.0
    """Seconds without packets and states after which a switch no longer holds up the windows of the others."""
    records: int = 4096
    """Most records of Kafka in a batch."""
    options: dict[str, str] = {}
    """Further options of Spark, as `spark.executor.memory`."""


class SonataSparkService:
    """Runs queries on Spark for as long as it lives."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._settings = settings
        self._lock = threading.Lock()
        self._intake = Intake(_LOG)
        self._bases: dict[str, int] = {}
        """Switch to absolute time of its clock zero, us."""
        self._times: dict[str, int] = {}
        """Switch to the capture time that it has reached, us."""
        self._clock: ReadClock | None = None
        self._slowest: SlowestSwitch | None = None
        self._clock_at = 0.0
        self._changed = False
        """Whether a clock zero is another than the streams know."""
        self._requests: dict[str, QueryRequest] = {}
        self._streams: list[KafkaWindows] = []
        self._session: Any = None
        self._again_at = 0.0
        self._failures = 0
        self._told = {"packets": 0, "refused": 0, "late": 0, "batches": 0}
        self._ended = dict(self._told)
        """Counts of streams that have ended."""
        self._written = 0

    def start(self) -> None:
        """Start Spark, and listen for the states of switches.

        Raises:
            InvalidOption: a setting is wrong, or Spark is not installed.
        """
        self._source = KafkaPackets(
            address=kafka_address(self._engine.options.updates),
            pattern=packets_key(self._settings.packets),
            clocks=REACHED,
            group=APP,
            at_once=self._settings.records,
        )
        self._checkpoint = checkpoint(self._settings, str(self._engine.options.folder() / "spark"))
        try:
            self._requests = requests(self._settings.queries)
            self._session = cluster_session(place(self._settings))
        except SonataError as error:
            raise InvalidOption(str(error)) from None
        self._engine.declare(interests=(Interest(SWITCHES), Interest(self._source.pattern)))
        on_switch = self._intake.reading("switch", state_in, self._on_switch)
        for item in read_latest(self._engine, {"dataKey": SWITCHES}, 0, _STATES_READ):
            on_switch(item)
        self._engine.observe(SWITCHES).subscribe(on_switch)

    def tick(self) -> None:
        """Start the streams when the switches are known; start those again that have ended.

        Raises:
            SonataError: they end again and again.
        """
        now = time.monotonic()
        with self._lock:
            bases, changed = dict(self._bases), self._changed
        if not self._engine.active or changed:
            self._end()
        if not self._engine.active or not bases or now < self._again_at:
            return
        if not self._streams:
            with self._lock:
                self._changed = False
            self._begin(bases)
        for stream in self._streams:
            if not stream.active:
                self._ended_by_itself(stream, now)
                return
        if self._slowest is not None and now >= self._clock_at:
            self._clock_at = now + _CLOCK_S
            self._pass_time(self._slowest, now)

    def stop(self) -> None:
        """End the streams; what is open stays in the checkpoint."""
        self._end()
        if self._clock is not None:
            self._clock.close()
        if self._session is not None:
            self._session.stop()

    def health(self) -> dict[str, Any]:
        """Counters for `health`."""
        told = self._counts()
        if told["batches"] > self._told["batches"]:
            self._failures = 0
        self._told = told
        return {
            **told,
            "results": self._written,
            "switches": sorted(self._bases),
            "idle": [] if self._slowest is None else self._slowest.idle,
            "streams": len(self._streams),
            "failures": self._failures,
            **self._intake.health(),
        }

    def _on_switch(self, item: Item, state: SwitchPrograms) -> None:
        name = item.key.rpartition(".")[2]
        if state.base_us is None:
            return
        with self._lock:
            if name not in self._bases:
                self._again_at = time.monotonic() + _SETTLE_S
            self._changed |= self._bases.get(name, state.base_us) != state.base_us
            self._bases[name] = state.base_us
            self._times[name] = max(state.event_time // 1000, self._times.get(name, 0))

    def _pass_time(self, slowest: SlowestSwitch, now: float) -> None:
        """Tell Spark how far time has come in what it has read."""
        if self._clock is None:
            self._clock = ReadClock(self._source.address, APP, self._source.topic)
        read, newest = zip(*(stream.read() for stream in self._streams), strict=True)
        everywhere = set.intersection(*map(set, newest))
        slowest.move({switch: min(each[switch] for each in newest) for switch in everywhere}, now)
        heard = self._clock.due(read)
        if heard is not None:
            noted, times = heard
            slowest.move(times, now)
            slowest.all_read(noted)
        with self._lock:
            times = dict(self._times)
        self._clock.note(times, now)
        time_us = slowest.next(now)
        if time_us:
            self._tell(time_us)

    def _tell(self, time_us: int) -> None:
        value = {"time": time_us * 1000}
        self._engine.write(REACHED, value, [NO_WAIT, PUB_ONLY], event_time=time_us * 1000)

    def _begin(self, bases: dict[str, int]) -> None:
        self._slowest = SlowestSwitch(bases, time.monotonic(), self._settings.idle_s)
        self._tell(0)  # so that there is a topic
        self._engine.flush(_FLUSH_S)
        lengths: dict[int, list[QueryRequest]] = {}
        for request in self._requests.values():
            lengths.setdefault(request.query.window_us, []).append(request)
        for length, found in sorted(lengths.items()):
            job = WindowJob(
                queries=tuple(msgspec.json.encode(request.query).decode() for request in found),
                length_us=length,
                limit=self._settings.keys,
                bases=bases,
                pattern=self._settings.packets,
                clocks=self._source.clock_topic,
                packets_in=data_in,
                clock_in=reached_us,
            )
            self._streams.append(
                KafkaWindows(
                    self._session,
                    self._source,
                    job,
                    lateness_us=min(self._settings.lateness_us, length // 4),
                    checkpoint=f"{self._checkpoint}/{length}us",
                    take=self._take,
                    every_s=self._settings.every_s,
                )
            )

    def _end(self) -> None:
        self._ended = self._counts()
        for stream in self._streams:
            stream.stop()
        self._streams = []

    def _counts(self) -> dict[str, int]:
        counts = [self._ended, *(stream.counts() for stream in self._streams)]
        return {name: sum(each[name] for each in counts) for name in self._ended}

    def _ended_by_itself(self, stream: KafkaWindows, now: float) -> None:
        self.health()
        try:
            stream.check()
        except UnknownSwitch as error:
            _LOG.info("packets of %s came before its state; reading them again", error)
        except SonataError as error:
            self._failures += 1
            if self._failures >= _MOST_FAILURES:
                raise
            _LOG.warning("%s; starting it again", error)
        self._end()
        self._again_at = now + _AGAIN_S

    def _take(self, results: Sequence[tuple[str, QueryResult]]) -> None:
        """Write results; a batch of Spark is done when DUE has them."""
        for _, result in results:
            key = self._requests[result.query].output.replace(QUERY_PREFIX, RESULTS, 1)
            self._engine.write(key, result.to_value(), [NO_WAIT], event_time=result.at_us * 1000)
        self._engine.flush(_FLUSH_S)
        self._written += len(results)


def reached_us(item: Item) -> int:
    """Capture time up to which all switches' packets were read, us.  Raises `MessageError`."""
    sender_of(item)
    time_ns = item.value.get("time") if isinstance(item.value, dict) else None
    if type(time_ns) is not int or not 0 <= time_ns <= LATEST_NS:
        raise MessageError("fields", f"{item.key}: time is ns since 1970")
    return time_ns // 1000


def requests(queries: Sequence[str]) -> dict[str, QueryRequest]:
    """What the settings ask for, by the names of the queries.

    Raises:
        InvalidRequest: one cannot be run, or there is none.
    """
    found = {}
    for text in queries:
        request = request_of(text if "." in text else f"{QUERY_PREFIX}.{text}", CATALOGUE)
        if request is None or request.kind != "query":
            raise InvalidRequest(f"queries: {text}: name one query, such as syn_flood:window=2s")
        found[streamed(request.query).name] = request
    if not found:
        raise InvalidRequest("queries: there are none; name some, such as syn_flood:window=2s")
    return found


def packets_key(key: str) -> str:
    """The key of the packets; raises `InvalidOption` if it is another one."""
    parsed = Key.parse(key)
    kinds = {f"network.{kind}.p4runtime_ctrl" for kind in ("packets", "frames")}
    if ".".join(parsed.segments[:3]) not in kinds or len(parsed.segments) != _SEGMENTS or parsed.specs:
        raise InvalidOption(
            f"packets {key}: write network.packets.p4runtime_ctrl.*.all, or network.frames.p4runtime_ctrl.*.all"
        )
    return parsed.path


def kafka_address(url: str) -> KafkaAddress:
    """Where the packets are; raises `InvalidOption` where Data Updates are not on Kafka."""
    if not url.startswith(tuple(f"{scheme}://" for scheme in SCHEMES)):
        raise InvalidOption(f"{APP} reads packets from Kafka: give --updates kafka://HOST:PORT")
    return parse_kafka_url(url)


def checkpoint(settings: Settings, folder: str) -> str:
    """Where Spark keeps its state; raises `InvalidOption` where a cluster could not reach it."""
    if "://" in settings.checkpoint:
        return settings.checkpoint.rstrip("/")
    if settings.spark_master.startswith(MASTER):
        raise InvalidOption(
            f"checkpoint {settings.checkpoint!r}: on a cluster give a place that all machines reach, as "
            "hdfs://HOST:PORT/sdnator, or file:///FOLDER for a folder that all have mounted"
        )
    return settings.checkpoint or folder


def place(settings: Settings) -> SparkPlace:
    """Where Spark runs; raises `SparkMissing`."""
    host = settings.driver_host or way_to(settings.spark_master)
    return SparkPlace(
        master=settings.spark_master,
        driver_host=host,
        jars=kafka_connector_jars(settings.jars),
        python=settings.python,
        options=settings.options,
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the queries until a signal ends them."""
    return int(due.service.run(APP, SonataSparkService, Settings, INTERESTS, CAPABILITIES, argv))


if __name__ == "__main__":
    sys.exit(main())
