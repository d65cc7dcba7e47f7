"""What Spark's workers do, without Spark: frames of Kafka in, the host engine's results out."""

import importlib.util
from collections import defaultdict

import msgspec
import pytest

from apps.sonata_adapter.arrivals import data_in
from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.host.spark_records import (
    NO_QUERY,
    UnknownSwitch,
    WindowJob,
    read_records,
    run_windows,
)
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.spark_service import REACHED, reached_us
from due import Item
from due.codec import pack
from sdnator.testing.query_traffic import BASE_US, batch_of, mixed
from sdnator.testing.spark_stage import frames_value
from tests.requirements import missing

PACKETS = "network.frames.p4runtime_ctrl.*.all"
CLOCKS = "due.b.sonata_spark.network.reached"
TOPIC = "due.r.p4runtime_ctrl.network.frames"
LENGTH_US = 2_000_000
BASES = {"s1": BASE_US + 300_000, "s2": BASE_US - 7_123_456}


@pytest.fixture(scope="module")
def arrow():
    if importlib.util.find_spec("pyarrow") is None:
        missing("pyarrow is not installed: pip install 'sdnator[arrow]'")
    import pyarrow as pa

    return pa


def job(queries=tuple(CATALOGUE), bases=BASES):
    found = [CATALOGUE[name].query({"window": LENGTH_US // 1000}) for name in queries]
    return WindowJob(
        queries=tuple(msgspec.json.encode(query).decode() for query in found),
        length_us=LENGTH_US,
        limit=1 << 20,
        bases=dict(bases),
        pattern=PACKETS,
        clocks=CLOCKS,
        packets_in=data_in,
        clock_in=reached_us,
    )


def payload(key, value, app="p4runtime_ctrl", number=1):
    return pack([Item(key, value, 1, 1, app, "i", number)]).payload


def records(switch, frames, size=500):
    key = f"network.frames.p4runtime_ctrl.{switch}.all"
    return [
        (TOPIC, key, payload(key, frames_value(frames[at : at + size], at), number=at + 1))
        for at in range(0, len(frames), size)
    ]


def batches(arrow, found, rows=3):
    for at in range(0, len(found), rows):
        part = found[at : at + rows]
        yield arrow.RecordBatch.from_pydict(
            {
                "topic": [topic for topic, _, _ in part],
                "key": [key.encode() for _, key, _ in part],
                "value": [value for _, _, value in part],
                "offset": list(range(at, at + len(part))),
            }
        )


def rows_of(arrow, found, work):
    return [row for batch in read_records(batches(arrow, found), work) for row in batch.to_pylist()]


def results(arrow, rows, work):
    """Grouped as Spark does, and in an order of chance."""
    groups = defaultdict(list)
    for row in reversed(rows):
        if row["query"] != NO_QUERY:
            window = row["time"] // work.length_us
            groups[window, row["switch"], row["query"], row["shard"]].append(
                {"offset": row["offset"], "packets": row["packets"]}
            )
    table = arrow.RecordBatch.from_pylist(
        [{"switch": key[1], "query": key[2], "pieces": pieces} for key, pieces in groups.items()]
    )
    return sorted(
        (row["switch"], row["result"]) for batch in run_windows([table], work) for row in batch.to_pylist()
    )


def truth(traffic, work):
    found = []
    for switch, frames in traffic.items():
        engine = HostEngine(base_us=work.bases[switch])
        for query in work.parsed():
            engine.add(query)
        outputs = [*engine.process(batch_of(frames)), *engine.finish()]
        found += [(switch, msgspec.json.encode(each).decode()) for each in outputs]
    return sorted(found)


def test_workers_find_what_the_host_engine_finds(arrow):
    """All queries, two switches whose windows begin at different times, frames that came twice."""
    traffic = {"s1": mixed(CATALOGUE, seconds=18), "s2": mixed(["ddos", "syn_flood"], seconds=5, seed=2)}
    work = job()
    found = records("s1", traffic["s1"]) + records("s2", traffic["s2"])
    found.insert(2, found[1])
    wanted = truth(traffic, work)
    assert {msgspec.json.decode(text)["query"] for _, text in wanted} == {q.name for q in work.parsed()}
    assert results(arrow, rows_of(arrow, found, work), work) == wanted


def test_rows_tell_how_far_time_has_come(arrow):
    """Each switch by its newest packet, and all together by what the driver says."""
    frames = mixed([], seconds=1)
    clock = payload(REACHED, {"time": (BASE_US + 5_000_000) * 1000}, app="sonata_spark")
    found = [*records("s1", frames), (CLOCKS, REACHED, clock)]
    work = job(["ddos"])
    times = {}
    for row in rows_of(arrow, found, work):
        if row["query"] == NO_QUERY:
            times[row["switch"]] = max(row["time"], times.get(row["switch"], 0))
    assert times["s1"] + work.shift_us("s1") == max(frame.time_us for frame in frames)
    # no window of a switch is over before the time that was told
    assert times[""] + max(map(work.shift_us, BASES)) == BASE_US + 5_000_000


def test_what_cannot_be_read_is_counted(arrow):
    """Garbage, frames of another app, and frames under another key than their own."""
    key = "network.frames.p4runtime_ctrl.s1.all"
    value = frames_value(mixed([], seconds=1)[:10], 0)
    found = [
        (TOPIC, key, b"garbage"),
        (TOPIC, key, payload(key, value, app="somebody")),
        (TOPIC, key, payload("network.frames.p4runtime_ctrl.s2.all", value)),
        (TOPIC, key, payload(key, {"frames": 1})),
        (TOPIC, "network.frames.p4runtime_ctrl.s1.q1", payload(key, value)),
    ]
    rows = rows_of(arrow, found, job(["ddos"]))
    assert sum(row["refused"] for row in rows) == 4
    assert all(row["time"] is None for row in rows)


def test_an_unknown_switch_is_no_reason_to_pass_packets_over(arrow):
    """Their windows are unknown: the stream has to begin again when they are known."""
    found = records("s9", mixed([], seconds=1)[:10])
    with pytest.raises(UnknownSwitch, match="s9"):
        rows_of(arrow, found, job(["ddos"]))
