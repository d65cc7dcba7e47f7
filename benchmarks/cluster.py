"""Data Updates past one server, under faults: `python -m benchmarks.cluster --json FILE [--rounds N] [--only NAME …]`.

    sentinel  a primary, two replicas and three sentinels        cluster_sentinel.py
    kafka     three brokers                                      cluster_kafka.py
    bridge    two sites with servers and Coordinators of their   cluster_bridge.py
              own, joined by 10 Mb/s with 50 ms each way
    shards    instances of Kitsune that divide two switches      cluster_shards.py
    plan      what `sdnator plan` predicts, against a run with   cluster_plan.py
              two and four switches; needs root
    spark     Kafka, HDFS and a Spark cluster of two workers     cluster_spark.py

Servers are killed, frozen, or killed together with a producer right after its `flush`, while a reliable stream is
written and read; the bridge's link is cut, and the bridge killed.

`…_acknowledged_lost`: items that `flush` covered and the reader never got, in all rounds.  `failover_ms_p50`: the
median of the reader's longest pauses, where the primary, or the broker that leads the stream's partition, was killed.
`kafka_msgs_per_s`: messages of 100 bytes on a reliable path; `kafka_vs_raw`: the same against confluent-kafka alone,
with frames of 100.  `bridge_lost`: reliable items acknowledged at the one site and never delivered at the other;
`bridge_uncounted`: best-effort items that were missing there and not counted as gaps, or the other way round.
`shard_scores_equal`: the largest difference of a packet's score from that of an undisturbed run.  `plan_error`: of the
cores that were predicted.
`spark_equal_queries`: queries whose results on the cluster are those of the host engine, though a worker was killed;
`spark_speedup_2_workers`: packets a second with two of them, by those with one.

A part that cannot run on this machine says why in `NAME_missing`, one that broke in `NAME_failed`.  Exit code: 1 where
a part broke, something was lost, or something best-effort was missing and not counted.
"""

import importlib
import os
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.cluster_stage import PartMissing
from benchmarks.measure import arguments, machine, table, write_json

PARTS: Mapping[str, float] = {
    "sentinel": 420.0,
    "kafka": 600.0,
    "bridge": 420.0,
    "shards": 180.0,
    "spark": 300.0,
    "plan": 0.0,
}
"""Modules `benchmarks.cluster_NAME`, and after how many seconds no further round begins."""
NONE_LOST = ("sentinel_acknowledged_lost", "kafka_acknowledged_lost", "bridge_lost", "bridge_uncounted")
MOST_DIFFERENCE = 1e-12
"""Of a score."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run all parts, print, write; 1 where something was lost or broke."""
    parser = arguments("cluster", __doc__, rounds=5)
    parser.add_argument("--only", nargs="+", choices=sorted(PARTS), metavar="NAME", help="these parts only")
    options = parser.parse_args(argv)
    figures: dict[str, Any] = {"machine": machine(), "failover_ms_p50": {}}
    for name in PARTS:
        if options.only and name not in options.only:
            continue
        print(f"{name} …", file=sys.stderr, flush=True)
        found = _run(name, options.rounds, options.scale)
        figures["failover_ms_p50"] |= found.pop("failover_ms_p50", {})
        figures |= found
        write_json(options.json, figures)  # what there is, should the next part be ended
    table(["figure", "value"], _flat(figures))
    broken = any(figures.get(name) for name in (*NONE_LOST, *(f"{part}_failed" for part in PARTS)))
    return int(broken or figures.get("shard_scores_equal", 0.0) > MOST_DIFFERENCE)


def _run(name: str, rounds: int, scale: float) -> dict[str, Any]:
    began = time.monotonic()
    try:
        part = importlib.import_module(f"benchmarks.cluster_{name}")
        found = _plan(part, scale) if name == "plan" else part.figures(rounds, scale, began + PARTS[name])
    except (PartMissing, ModuleNotFoundError) as error:
        print(f"{name}: {error}", file=sys.stderr, flush=True)
        return {f"{name}_missing": str(error)}
    except Exception as error:  # noqa: BLE001 - one part must not cost the figures of the others
        traceback.print_exc()
        return {f"{name}_failed": f"{type(error).__name__}: {error}"}
    return {**found, f"{name}_seconds": time.monotonic() - began}


def _plan(part: Any, scale: float) -> dict[str, Any]:
    if os.geteuid() != 0:
        raise PartMissing("needs root, for the interfaces of the switches")
    return dict(part.figures_of(part.PPS, scale * part.SECONDS))


def _flat(figures: Mapping[str, Any], before: str = "") -> list[tuple[str, Any]]:
    """Names and values to print, one a line; lists are for the file."""
    rows: list[tuple[str, Any]] = []
    for name, value in figures.items():
        if isinstance(value, Mapping):
            rows += _flat(value, f"{before}{name}.") if name != "machine" else []
        elif not isinstance(value, list):
            rows.append((before + name, value))
    return rows


if __name__ == "__main__":
    sys.exit(main())
