"""What Spark's workers do with archived packets, without Spark: the host engine's results, late packets left out."""

import importlib.util
import random

import msgspec
import numpy as np
import pytest

from apps.packets import PACKET_COLUMNS
from apps.sonata_adapter.host.archive_columns import ITEM, KEY, ROW, WRITTEN
from apps.sonata_adapter.host.engine import DEFAULT_LATENESS_US, HostEngine
from apps.sonata_adapter.host.spark_archive_rows import ArchiveJob, in_order, run_groups, split_rows
from apps.sonata_adapter.host.spark_late import ClockRow, Closings, WindowClock, clock_rows, closings_of
from apps.sonata_adapter.query.catalogue import CATALOGUE
from due import RecordBatch
from sdnator.testing.archived_packets import out_of_order
from sdnator.testing.packet_rows import blank
from sdnator.testing.query_traffic import BASE_US, batch_of, mixed
from tests.requirements import missing

BASES = {"s1": BASE_US + 300_000, "s2": BASE_US - 7_123_456}


@pytest.fixture(scope="module")
def arrow():
    if importlib.util.find_spec("pyarrow") is None:
        missing("pyarrow is not installed: pip install 'sdnator[arrow]'")
    import pyarrow as pa

    return pa


@pytest.fixture(scope="module")
def traffic():
    """Items of two switches; packets are on their way for up to four seconds, and items of different sizes."""
    rng = random.Random(3)
    found = {}
    for switch, frames in (
        ("s1", mixed(CATALOGUE, seconds=18)),
        ("s2", mixed(["ddos", "syn_flood"], seconds=8, seed=2)),
    ):
        late, items, at = out_of_order(frames, 4_000_000), [], 0
        while at < len(late):
            size = rng.choice([1, 20, 300])
            items.append(batch_of(late[at : at + size], at))
            at += size
        found[switch] = items
    return found


def archived(arrow, traffic, rows=700):
    """Arrow batches as Spark reads them out of Parquet: the archive's rows, cut where it pleases, in an order of chance."""
    numbered = [(switch, batch) for switch, items in traffic.items() for batch in items]
    random.Random(1).shuffle(numbered)
    order = {switch: iter(items) for switch, items in traffic.items()}
    numbered = [(switch, next(order[switch])) for switch, _ in numbered]
    tables, at = [], 7 << 40
    for switch, batch in numbered:
        size = len(batch)
        key = f"network.packets.p4runtime_ctrl.{switch}.all"
        columns = {
            KEY: [key] * size,
            WRITTEN: np.zeros(size, "i8"),
            ITEM: np.full(size, at),
            ROW: np.arange(at, at + size),
        }
        wide = {"u1": "i2", "u2": "i4", "u4": "i8"}
        for name, kind in PACKET_COLUMNS.items():
            found = arrow.array(batch[name].astype(wide.get(kind, kind)))
            columns[name] = found.cast(arrow.decimal128(20, 0)) if kind == "u8" else found
        tables.append(arrow.table(columns))
        at += size
    # as if each second of event time were an hour with files of its own
    whole = arrow.concat_tables(tables)
    seconds = whole["time_us"].to_numpy() // 10**6
    parts = [whole.filter(arrow.array(seconds == each)) for each in np.unique(seconds)]
    random.Random(2).shuffle(parts)
    return arrow.concat_tables(parts).combine_chunks().to_batches(max_chunksize=rows)


def results(arrow, batches, query):
    """Grouped and sorted as Spark does."""
    clock = WindowClock(
        length_us=query.window_us, lateness_us=min(DEFAULT_LATENESS_US, query.window_us // 4), bases=BASES
    )
    least = {}
    for made in clock_rows(batches, clock):
        for row in (ClockRow(**row) for row in made.to_pylist()):
            name = row.switch, row.kind, row.number
            known = least.get(name, row)
            best = min((known.item, known.time), (row.item, row.time))
            packets = row.packets + (known.packets if name in least else 0)
            least[name] = row._replace(item=best[0], time=best[1], packets=packets)
    closings, starts = closings_of(arrow.Table.from_pylist([row._asdict() for row in least.values()]))
    job = ArchiveJob(query=msgspec.json.encode(query).decode(), limit=1 << 20, clock=clock, closings=closings)
    pieces = arrow.Table.from_batches(list(split_rows(batches, job)))
    groups = pieces.sort_by([(name, "ascending") for name in ("switch", "number", "shard", "row")])
    rows = [row for made in run_groups(groups.to_batches(max_chunksize=3), job) for row in made.to_pylist()]
    found = sorted((row["switch"], row["result"]) for row in rows if row["result"])
    return found, sum(row["late"] for row in rows), starts


def truth(traffic, query):
    found, late = [], 0
    for switch, items in traffic.items():
        engine = HostEngine(base_us=BASES[switch])
        engine.add(query)
        outputs = [each for batch in items for each in engine.process(batch)] + engine.finish()
        found += [(switch, msgspec.json.encode(each).decode()) for each in outputs]
        late += engine.late
    return sorted(found), late


@pytest.mark.parametrize("name", CATALOGUE)
def test_workers_find_what_the_host_engine_finds(arrow, traffic, name):
    """Every query, with packets out of order and too late, whichever rows come together."""
    headers = {
        switch: [RecordBatch({column: batch[column] for column in PACKET_COLUMNS}) for batch in items]
        for switch, items in traffic.items()
    }
    query = CATALOGUE[name].query({"window": 1_000})
    wanted, late = truth(headers, query)
    found, left_out, starts = results(arrow, archived(arrow, headers), query)
    assert found == wanted
    assert left_out == late > 0
    assert sum(row.packets for row in starts.values()) == sum(
        len(batch) for items in headers.values() for batch in items
    )
    for switch, row in starts.items():
        assert row.time == int(headers[switch][0]["time_us"][0])
    if name not in ("dns_tunnel", "dns_reflection", "zorro"):  # they read payloads, which no archive has
        assert found


@pytest.mark.parametrize("seed", range(20))
def test_late_packets_are_those_of_the_host_engine(seed):
    """Item by item, though time jumps ahead and back over many windows, and some windows are never begun."""
    rng = np.random.default_rng(seed)
    engine = HostEngine(base_us=BASES["s1"])
    engine.add(CATALOGUE["new_tcp"].query({"window": 1_000}))
    clock = WindowClock(length_us=1_000_000, lateness_us=250_000, bases=BASES)
    now, wanted, items = BASE_US + 60_000_000, [], []
    for _ in range(60):
        now += int(rng.choice([0, 200_000, 900_000, 7_000_000, -3_000_000], p=[0.2, 0.4, 0.2, 0.1, 0.1]))
        items.append(now + rng.integers(-1_500_000, 1_500_000, rng.integers(1, 6)))
        before = engine.late
        engine.process(blank(len(items[-1]), time_us=items[-1]))
        wanted.append(engine.late - before)
    tables = []
    for windows in (clock.windows, clock.closed_by):
        numbers = [windows("s1", times).tolist() for times in items]
        least = {each: item for item, found in reversed([*enumerate(numbers)]) for each in found}
        tables += [np.array([*least]), np.array([*least.values()])]
    closings = Closings(*tables)
    found = [
        int(closings.late(clock.windows("s1", times), np.full(len(times), item)).sum())
        for item, times in enumerate(items)
    ]
    assert found == wanted
    assert any(wanted)


def test_pieces_that_overlap_are_merged(arrow):
    """Rows come in their order, and what is complete is passed on."""

    def piece(*rows):
        return RecordBatch({ROW: np.array(rows), "x": np.array(rows) * 2})

    found = list(
        in_order([piece(1, 4), piece(2, 3), piece(5), piece(6, 9), piece(7), piece(8, 20), piece(21)])
    )
    assert [batch[ROW].tolist() for batch in found] == [[1, 2, 3, 4], [5], [6, 7, 8, 9, 20], [21]]
    assert all((batch["x"] == 2 * batch[ROW]).all() for batch in found)
    assert list(in_order([])) == []
