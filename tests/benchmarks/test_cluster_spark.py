"""Without Spark the part says why; results are compared query by query."""

import pytest

from apps.sonata_adapter.host.spark import SparkMissing
from benchmarks import cluster_spark
from benchmarks.cluster_stage import PartMissing


def test_spark_without_its_jars_is_missing(monkeypatch):
    def no_maven() -> None:
        raise SparkMissing("Maven copies the jars")

    monkeypatch.setattr(cluster_spark, "kafka_jars", lambda: None)
    monkeypatch.setattr(cluster_spark, "kafka_connector_jars", no_maven)
    with pytest.raises(PartMissing, match="Maven copies the jars"):
        cluster_spark.figures(1, 1.0, 0.0)


def test_a_query_is_equal_if_it_found_all_of_it_and_no_more():
    """`ddos` found something else, `dns` is another query than `dns_tunnel`, `zorro` found nothing at all."""
    wanted = ["ddos window=2s a", "dns_tunnel window=2s b", "port_scan window=2s c"]
    given = ["ddos window=2s x", "dns_tunnel window=2s b", "port_scan window=2s c", "port_scan window=2s d"]
    assert cluster_spark.equal(given, wanted, ["ddos", "dns", "dns_tunnel", "port_scan", "zorro"]) == [
        "dns_tunnel"
    ]
