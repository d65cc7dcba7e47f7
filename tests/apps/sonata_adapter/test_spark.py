"""Spark in place of numpy: the same results from the same frames, shard by shard."""

import importlib.util

import pytest

from apps.sonata_adapter.catalogue import CATALOGUE
from apps.sonata_adapter.columns import Packets
from apps.sonata_adapter.engine import HostEngine
from apps.sonata_adapter.shards import parts_of, shard_rows, union
from apps.sonata_adapter.spark import SHARDS, SparkMissing, require_spark, run_window, split_batch
from sdnator.captures import CaptureWriter
from tests.apps.sonata_adapter.traffic import BASE_US as TRAFFIC_US
from tests.apps.sonata_adapter.traffic import batch_of, mixed
from tests.end_to_end.command import sdnator
from tests.requirements import missing, require_program


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
    rows = shard_rows(part, Packets(batch), SHARDS)
    assert set(rows) == set(range(SHARDS))
    hosts = [set(batch["ip_dst_lo"][mine].tolist()) for mine in rows.values()]
    assert sum(map(len, hosts)) == len(set().union(*hosts))
    assert len(union(list(rows.values()))) == int((batch["ip_version"] != 0).sum())


def test_what_is_missing_is_said(monkeypatch):
    """Before anything starts, with what to do."""
    monkeypatch.delenv("JAVA_HOME", raising=False)
    monkeypatch.setattr("apps.sonata_adapter.spark.find_spec", lambda _: None)
    with pytest.raises(SparkMissing, match=r"pip install 'sdnator\[spark\]'"):
        require_spark()
    monkeypatch.setattr("apps.sonata_adapter.spark.find_spec", lambda _: True)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SparkMissing, match="install a JRE"):
        require_spark()


@pytest.mark.timeout(900)
def test_spark_finds_what_numpy_finds(tmp_path):
    """A real local Spark: the same lines from the same capture, crossings and window ends alike."""
    if importlib.util.find_spec("pyspark") is None:
        missing("pyspark is not installed: pip install 'sdnator[spark]'")
    require_program("java")
    file = tmp_path / "mixed.pcap"
    with CaptureWriter(file) as writer:
        for frame in mixed(["ddos", "syn_flood"], seconds=8):
            writer.write(frame.time_us * 1000, frame.data, frame.length)
    lines = {engine: results("syn_flood:window=2s", file, engine) for engine in ("numpy", "spark")}
    assert lines["numpy"]
    assert lines["spark"] == lines["numpy"]


def results(query, file, engine):
    done = sdnator("queries", "run", query, "--capture", file, "--json", "--engine", engine, seconds=800)
    assert done.returncode == 0, done.stderr[-3000:]
    return sorted(line for line in done.stdout.splitlines() if line.startswith("{"))
