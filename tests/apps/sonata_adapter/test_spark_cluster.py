"""Spark reads Kafka itself, on two workers that share no folder, and finds what the host engine finds."""

import importlib.util
import re
import tempfile
import time
from contextlib import closing
from pathlib import Path

import msgspec
import pytest

from apps.sonata_adapter.errors import InvalidRequest
from apps.sonata_adapter.host.spark import SparkMissing
from apps.sonata_adapter.host.spark_jars import kafka_connector_jars
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.spark_service import Settings, checkpoint, kafka_address, packets_key, requests
from due.backends import open_archive
from due.errors import InvalidOption
from sdnator.errors import PipelineError
from sdnator.testing.archived_packets import archive_packets, out_of_order
from sdnator.testing.kafka_servers import KafkaMissing
from sdnator.testing.query_traffic import BASE_US, mixed
from sdnator.testing.spark_stage import SparkStage, texts, truth
from sdnator.testing.waiting import wait_for
from tests.end_to_end.command import sdnator
from tests.requirements import missing

ROOT = Path(__file__).resolve().parents[3]
BASES = {"s1": BASE_US + 300_000, "s2": BASE_US - 7_123_456}


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    for module in ("pyspark", "pyarrow", "confluent_kafka"):
        if importlib.util.find_spec(module) is None:
            missing(f"{module} is not installed: pip install 'sdnator[arrow,kafka,spark]'")
    try:
        with SparkStage(tmp_path_factory.mktemp("stage")) as made:
            yield made
    except (KafkaMissing, SparkMissing) as reason:
        missing(str(reason))
    except PipelineError as error:
        pytest.fail(str(error))


@pytest.fixture
def mounted():
    """A folder that all machines have: the workers' /tmp is their own."""
    with tempfile.TemporaryDirectory(prefix="sdnator-test-", dir="/var/tmp") as made:
        yield Path(made)


@pytest.mark.timeout(600)
def test_a_day_of_the_archive_on_a_cluster(stage, mounted):
    """The command runs a query over an exported archive, and finds what the host engine finds."""
    url = f"sqlite://{mounted}/archive.db"
    begin_ns = 472_300 * 3_600 * 10**9 - 5 * 10**9
    with closing(open_archive(url)) as archive:
        for switch, seed in (("s1", 1), ("s2", 2)):
            frames = out_of_order(mixed(["ddos", "port_scan"], seconds=12, seed=seed), 4_000_000)
            archive_packets(archive, switch, frames, base_us=BASES[switch], begin_ns=begin_ns)
    command = ["queries", "run", "ddos:window=1s", "--archive", url, "--json"]
    command += ["--since", "2023-11-18T02:00:00+00:00", "--until", "2023-11-18T06:00:00+00:00"]
    spark = ["--engine", "spark", "--master", stage.cluster.url, "--parquet", mounted / "day"]
    for name, value in stage.cluster.options.items():
        spark += ["--spark-option", f"{name}={value}"]
    host, cluster = sdnator(*command), sdnator(*command, *spark)
    assert (host.returncode, cluster.returncode) == (0, 0), cluster.stderr[-3000:]
    assert sorted(cluster.stdout.splitlines()) == sorted(host.stdout.splitlines())
    assert host.stdout
    assert "after the result of their window" in host.stderr
    assert host.stderr.strip() in cluster.stderr


@pytest.mark.timeout(1800)
def test_a_worker_is_killed_and_the_results_are_those_of_the_host_engine(stage):
    """The whole catalogue over two switches, half behind the death of a worker, and one switch behind the other."""
    traffic = {"s1": mixed(CATALOGUE, seconds=18), "s2": mixed(["ddos", "syn_flood"], seconds=18, seed=2)}
    found = stage.results()
    controller = stage.controller()
    for switch, base_us in BASES.items():
        controller.state(switch, base_us)
    parts = {
        switch: [
            0,
            *(sum(frame.time_us < BASE_US + at for frame in frames) for at in (9_000_000, 30_000_000)),
        ]
        for switch, frames in traffic.items()
    }
    for switch, (first, half, _) in parts.items():
        controller.write(switch, traffic[switch][first:half], first)
    apps = [stage.app(every_s=0.2, idle_s=3_600.0)]
    health = []
    stage.engine("onlooker").observe("due.health.sonata_spark").subscribe(health.append)

    def tell(seconds):
        """As the controller does once a second."""
        apps[-1].check()
        for switch, base_us in BASES.items():
            controller.state(switch, base_us, BASE_US + seconds * 1_000_000)
        time.sleep(0.5)
        return len(found)

    def read():
        """How many packets Spark has read."""
        return health[-1].value["app"]["packets"] if health else 0

    wait_for(lambda: tell(9), 600, lambda: log(stage))
    stage.cluster.kill_worker(0)
    sent = sum(half for _, half, _ in parts.values())
    for switch, (_, half, end) in parts.items():
        controller.write(switch, traffic[switch][half:end], half)
        sent += end - half
        wait_for(lambda sent=sent: tell(9) and read() >= sent, 600, lambda: log(stage))
    wanted = truth(traffic, BASES)
    wait_for(lambda: tell(60) >= len(wanted), 900, lambda: log(stage))
    assert stage.cluster.alive() <= 1
    wait_for(lambda: health[-1].value["app"]["results"] >= len(wanted))
    assert health[-1].value["app"]["late"] == 0
    assert len({text.partition(" ")[0] for text in wanted}) >= 8
    assert texts(found) == wanted
    # another driver goes on where the checkpoint says
    apps[-1].stop()
    later = [
        frame._replace(time_us=frame.time_us + 70_000_000)
        for frame in mixed(["ddos", "port_scan"], seconds=6)
    ]
    controller.write("s1", later, len(traffic["s1"]))
    apps.append(stage.app(every_s=0.2, idle_s=3_600.0))
    wanted = truth({**traffic, "s1": [*traffic["s1"], *later]}, BASES)
    assert len(found) < len(wanted)
    wait_for(lambda: tell(130) >= len(wanted), 600, lambda: log(stage))
    assert texts(found) == wanted


def log(stage):
    return (stage.folder / "apps.sonata_adapter.spark_service.log").read_text(errors="replace")[-3000:]


def test_a_cluster_needs_a_place_that_all_machines_reach():
    """A folder of this machine would be lost to a worker elsewhere."""
    with pytest.raises(InvalidOption, match="hdfs://HOST:PORT"):
        checkpoint(Settings(spark_master="spark://h:7077", checkpoint="/var/lib/spark"), "/state/spark")
    assert checkpoint(Settings(spark_master="spark://h:7077", checkpoint="hdfs://n:9000/s/"), "/x") == (
        "hdfs://n:9000/s"
    )
    assert checkpoint(Settings(), "/state/spark") == "/state/spark"


@pytest.mark.parametrize(
    ("queries", "text"),
    [
        ((), "there are none"),
        (("nothing",), "there is no query nothing"),
        (("network.traffic_capture.sonata.dns",), "name one query"),
    ],
)
def test_what_spark_cannot_run_is_said(queries, text):
    with pytest.raises(InvalidRequest, match=text):
        requests(queries)


def test_the_settings_of_the_documentation_can_be_read():
    text = (ROOT / "docs" / "sonata.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"`spark\.json`:\n\n```json\n(.*?)```", text, re.DOTALL)
    settings = msgspec.json.decode(block, type=Settings)
    assert [request.name for request in requests(settings.queries).values()] == ["ddos", "syn_flood"]
    assert checkpoint(settings, "") == settings.checkpoint


def test_packets_come_from_kafka_alone():
    with pytest.raises(InvalidOption, match="kafka://HOST:PORT"):
        kafka_address("redis://127.0.0.1:6379")
    assert kafka_address("kafka://h:9092/lab").namespace == "lab"


@pytest.mark.parametrize(
    "key",
    [
        "network.packets.p4runtime_ctrl",
        "network.counts.p4runtime_ctrl.*.all",
        "network.packets.kitsune.*.all",
    ],
)
def test_other_items_are_no_packets(key):
    with pytest.raises(InvalidOption, match=r"network\.packets\.p4runtime_ctrl"):
        packets_key(key)
    assert packets_key("network.frames.p4runtime_ctrl.s1.all") == "network.frames.p4runtime_ctrl.s1.all"


def test_jars_without_the_source_are_no_use(tmp_path):
    if importlib.util.find_spec("pyspark") is None:
        missing("pyspark is not installed: pip install 'sdnator[spark]'")
    with pytest.raises(SparkMissing, match="spark-sql-kafka"):
        kafka_connector_jars(str(tmp_path))
