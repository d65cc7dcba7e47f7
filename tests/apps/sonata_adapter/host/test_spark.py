"""Spark in place of numpy: the same results from the same frames, shard by shard."""

import importlib.util
from contextlib import closing
from functools import partial

import pytest
from typer.testing import CliRunner

from apps.p4runtime_ctrl.service import CAPABILITIES as CONTROLLER
from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.host.shards import parts_of, shard_rows, union
from apps.sonata_adapter.host.spark import (
    SparkEngine,
    SparkMissing,
    require_spark,
    run_window,
    spark_session,
    split_batch,
)
from apps.sonata_adapter.host.spark_pieces import SHARDS
from apps.sonata_adapter.keys import QUERY_PREFIX, request_of
from apps.sonata_adapter.planner.placement import SwitchLimits
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.service import CAPABILITIES, INTERESTS, Settings, SonataAdapterService
from due import NO_WAIT
from due.backends import open_archive
from sdnator.capture.captures import CaptureWriter
from sdnator.cli.queries_commands import queries
from sdnator.testing.archived_packets import archive_packets, out_of_order
from sdnator.testing.controller_run import ControllerRun, Heard
from sdnator.testing.query_traffic import BASE_US as TRAFFIC_US
from sdnator.testing.query_traffic import batch_of, batches, mixed
from sdnator.testing.waiting import wait_for
from tests.requirements import missing, require_program

ARCHIVED_NS = 472_300 * 3_600 * 10**9 - 5 * 10**9
"""Five seconds before an hour of the archive ends; of what is written, PERIOD leaves out the end."""
PERIOD = ("--since", "2023-11-18T03:59:55+00:00", "--until", "2023-11-18T04:00:20+00:00")


@pytest.mark.parametrize("name", CATALOGUE)
def test_shards_together_find_what_one_engine_finds(name):
    """Every packet that a query needs is in a shard, and no shard needs another."""
    import msgspec

    batch = batch_of(mixed([name], seconds=6))
    query = CATALOGUE[name].query()
    base = TRAFFIC_US - TRAFFIC_US % query.window_us
    whole = HostEngine(base_us=base)
    whole.add(query)
    truth = {str(result.fields) for result in [*whole.process(batch), *whole.finish()]}
    text = msgspec.json.encode(query).decode()
    pieces: dict[tuple[int, int], list[bytes]] = {}
    for _, shard, time_us, data in split_batch([text], encoded(batch), query.window_us, base)[1:]:
        pieces.setdefault((shard, time_us // query.window_us), []).append(data)
    lines = [line for parts in pieces.values() for line in run_window(text, parts, base, 1 << 20)]
    assert {str(msgspec.json.decode(line)["fields"]) for line in lines} == truth
    assert len(lines) == len(set(lines))


def encoded(batch):
    from due.codec import encode_value

    return encode_value(batch)


def test_a_key_goes_to_one_shard():
    """And the shards are all used."""
    batch = batch_of(mixed(["ddos"], seconds=6))
    (part,) = parts_of(CATALOGUE["ddos"].query())
    rows = shard_rows(part, PacketColumns(batch), SHARDS)
    assert set(rows) == set(range(SHARDS))
    hosts = [set(batch["ip_dst_lo"][mine].tolist()) for mine in rows.values()]
    assert sum(map(len, hosts)) == len(set().union(*hosts))
    assert len(union(list(rows.values()))) == int((batch["ip_version"] != 0).sum())


def test_what_is_missing_is_said(monkeypatch):
    """Before anything starts, with what to do."""
    monkeypatch.delenv("JAVA_HOME", raising=False)
    monkeypatch.setattr("apps.sonata_adapter.host.spark.find_spec", lambda _: None)
    with pytest.raises(SparkMissing, match=r"pip install 'sdnator\[spark\]'"):
        require_spark()
    monkeypatch.setattr("apps.sonata_adapter.host.spark.find_spec", lambda _: True)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SparkMissing, match="install a JRE"):
        require_spark()


@pytest.fixture(scope="module")
def spark():
    """A real local Spark for the tests of this module, since it takes long to start."""
    if importlib.util.find_spec("pyspark") is None:
        missing("pyspark is not installed: pip install 'sdnator[spark]'")
    require_program("java")
    session = spark_session("local[2]")
    gateway = session.sparkContext._gateway
    yield
    session.stop()
    gateway.shutdown()
    gateway.proc.stdin.close()
    gateway.proc.wait(30)


@pytest.fixture(scope="module")
def frames():
    return mixed(["ddos", "syn_flood"], seconds=6)


@pytest.mark.timeout(600)
@pytest.mark.usefixtures("spark")
def test_spark_finds_what_numpy_finds(tmp_path, frames):
    """A real local Spark: the same lines from the same capture, crossings and window ends alike."""
    file = tmp_path / "mixed.pcap"
    with CaptureWriter(file) as writer:
        for frame in frames:
            writer.write(frame.time_us * 1000, frame.data, frame.length)
    lines = {engine: results("syn_flood:window=2s", file, engine) for engine in ("numpy", "spark")}
    assert lines["numpy"]
    assert lines["spark"] == lines["numpy"]


def results(query, file, engine):
    done = CliRunner().invoke(queries, ["run", query, "--capture", str(file), "--json", "--engine", engine])
    assert done.exit_code == 0, done.output[-3000:]
    return sorted(line for line in done.stdout.splitlines() if line.startswith("{"))


@pytest.mark.timeout(600)
@pytest.mark.usefixtures("spark")
def test_the_archive_on_spark_finds_what_it_finds_on_the_host(tmp_path):
    """Packets come late and cross hours; the lines, and what is said of the late ones, are the same."""
    if importlib.util.find_spec("pyarrow") is None:
        missing("pyarrow is not installed: pip install 'sdnator[arrow]'")
    names = ["new_tcp", "port_scan", "syn_flood", "arp_scan"]
    url, hour_us = f"sqlite://{tmp_path}/archive.db", 3_600 * 10**6
    shift_us = -TRAFFIC_US % hour_us - 7_000_000  # the hour ends seven seconds after the first packet
    with closing(open_archive(url)) as archive:
        for switch, base_us in (("s1", TRAFFIC_US + shift_us - 300_000), ("s2", TRAFFIC_US + 1_234_567)):
            frames = out_of_order(mixed(names, seconds=14, seed=len(switch)), 4_000_000)
            archive_packets(archive, switch, frames, base_us=base_us, begin_ns=ARCHIVED_NS, shift_us=shift_us)
    for number, name in enumerate(names[:3]):
        # the first one exports to a temporary folder, the others read the same one
        spark = ["--engine", "spark", *(("--parquet", str(tmp_path / "day")) if number else ())]
        command = ["run", f"{name}:window={number + 1}s", "--archive", url, "--json", *PERIOD]
        host, found = (CliRunner().invoke(queries, [*command, *more]) for more in ([], spark))
        assert found.exit_code == 0, found.output[-3000:]
        assert sorted(found.stdout.splitlines()) == sorted(host.stdout.splitlines())
        assert len(host.stdout.splitlines()) > number % 2
        assert found.stderr == host.stderr != ""


@pytest.mark.timeout(600)
@pytest.mark.usefixtures("spark")
def test_spark_fed_by_reliable_streams(tmp_path, frames):
    """The adapter on a real local Spark: packets come by DUE, and its results are those of the host's operators."""
    keys = [f"{QUERY_PREFIX}.{name}:window=2s" for name in ("ddos", "syn_flood")]
    packets = [*batches(frames, 256)]
    with ControllerRun(tmp_path) as stage:
        controller = stage.engine("p4runtime_ctrl", capabilities=CONTROLLER)
        found = Heard(stage.engine("observer"), *keys)
        engine = stage.engine("sonata_adapter", interests=INTERESTS, capabilities=CAPABILITIES)
        # with one bit, every packet is copied: what is sent and what is to be found are one input
        service = SonataAdapterService(
            engine, Settings(engine="spark", limits=SwitchLimits(bits=1, stages=0))
        )
        service.start()
        state = {"base_us": TRAFFIC_US, "primary": True}

        def knows_the_switch():
            controller.write("network.switch.p4runtime_ctrl.s1", state, [NO_WAIT])
            return service.health()["bits"] and service.health()["switches"]

        # best effort: said until it is heard
        wait_for(knows_the_switch, why=service.health)
        for batch in packets:
            wait_for(partial(controller.write, "network.packets.p4runtime_ctrl.s1.q0", batch))
        controller.flush()
        wait_for(partial(arrived, service, len(frames)), why=service.health)
        service.stop()
        truth = host_results(keys, packets)
        wait_for(lambda: len(found.items) >= len(truth))
        assert truth
        assert sorted(map(text_of_item, found.items)) == truth


@pytest.mark.timeout(600)
@pytest.mark.usefixtures("spark")
def test_spark_goes_on_when_a_clock_is_set_back(frames):
    """A day ahead, then set right: the same results as the host's operators, of the wrong time and of the right one."""
    ahead = [frame._replace(time_us=frame.time_us + 86_400_000_000) for frame in frames]
    query = request_of(f"{QUERY_PREFIX}.ddos:window=2s", CATALOGUE).query
    found = []
    for engine in (HostEngine(), SparkEngine()):
        engine.add(query)
        outputs = [each for batch in batches(ahead, 512) for each in engine.process(batch)]
        outputs += engine.set_back(frames[0].time_us)
        outputs += [each for batch in batches(frames, 512) for each in engine.process(batch)]
        outputs += engine.finish()
        engine.close()
        found.append(sorted(text_of_value(each.query, each.to_value()) for each in outputs))
    host, spark = found
    assert host
    assert spark == host


def arrived(service, count):
    """All packets have come; between them the adapter goes on as when it runs alone."""
    service.tick()
    return service.health()["host_packets"] >= count


def host_results(keys, packets):
    engine = HostEngine(base_us=TRAFFIC_US)
    for key in keys:
        engine.add(request_of(key, CATALOGUE).query)
    outputs = [found for batch in packets for found in engine.process(batch)] + engine.finish()
    return sorted(text_of_value(found.query, found.to_value()) for found in outputs)


def text_of_item(item):
    return text_of_value(item.key, item.value)


def text_of_value(key, value):
    return f"{key} {sorted(value.items())}"
