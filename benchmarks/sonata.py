"""Sonata queries, measured: `python -m benchmarks.sonata --json FILE`.

correct_queries: queries whose results, switch and host together, equal those of a naive evaluator on
generated attacks and on real captures.  reduction: packets for each tuple that reached the host, on
--packets packets (a tenth of them for queries that need copies).  host_tuples_per_s: filter, distinct and reduce on one core.
all_queries_cost_ratio: processor time of all eleven together over that of the dearest alone.
declare_to_first_result_ms: from writing a key to its first result, windows of one second, busy network.
lost_packets: not forwarded while 200 queries came and went.  Real processes, embedded switch.
"""

import random
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import count, cycle, islice
from pathlib import Path
from typing import Any

import numpy as np

from apps.sonata_adapter.catalogue import CATALOGUE
from apps.sonata_adapter.engine import HostEngine
from apps.sonata_adapter.keys import Request, request_of
from apps.sonata_adapter.planner import plan
from benchmarks import measure
from benchmarks.sonata_stage import QUERIES, SonataStage, equal_to_naive
from due import RecordBatch
from sdnator.captures import Capture
from tests.apps.sonata_adapter.traffic import BASE_US, Frame, attack, batch_of, mixed, office, tcp
from tests.requirements import shared_data

CAPTURES = ("synflood_spoofed", "synflood_one_source", "ssh_guessing", "ftp_bruteforce")
BATCH = 32_768
_BLOCK_S = 60
_BLOCKS = 12
_ATTACK_EVERY = 6


def main(argv: Sequence[str] | None = None) -> int:
    """Run all, print a table, write the figures."""
    parser = measure.arguments("sonata", __doc__, rounds=5)
    parser.add_argument("--packets", type=int, default=3_600_000, help="of the run for `reduction`")
    chosen = parser.parse_args(argv)
    figures: dict[str, Any] = {"machine": measure.machine()}
    figures |= host_figures(chosen.rounds)
    figures |= correctness()
    figures |= reduction(int(chosen.packets * chosen.scale))
    figures |= responsiveness(chosen.rounds)
    for name, value in figures.items():
        print(f"{name:28} {value}")
    measure.write_json(chosen.json, figures)
    return 0


def host_figures(rounds: int) -> dict[str, Any]:
    """The host's operators alone, in processor time, peers interleaved."""
    batches = _dense()
    packets = sum(map(len, batches))
    peers = {name: (lambda name=name: _cost([name], batches)) for name in CATALOGUE}
    costs = measure.interleaved({**peers, "all": lambda: _cost(list(CATALOGUE), batches)}, rounds)
    together = costs.pop("all")
    return {
        "host_packets": packets,
        "host_tuples_per_s": round(packets / costs["superspreader"]),
        "host_tuples_per_s_by_query": {name: round(packets / cost) for name, cost in costs.items()},
        "all_queries_tuples_per_s": round(packets / together),
        "all_queries_cost_ratio": round(together / max(costs.values()), 2),
    }


def _dense() -> list[RecordBatch]:
    """Many offices at once, and every attack."""
    parts = []
    for number in range(120):
        frames = mixed(CATALOGUE, seconds=_BLOCK_S) if number == 0 else _office(number)
        batch = batch_of(frames)
        columns = {name: batch[name].copy() for name in batch.columns}
        four = columns["ip_version"] == 4
        for name in ("ip_src_lo", "ip_dst_lo"):
            columns[name][four] ^= np.uint64(number << 8)
        parts.append(columns)
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(whole["time_us"], kind="stable")
    whole = {name: column[order] for name, column in whole.items()}
    size = len(order)
    return [
        RecordBatch({name: column[at : at + BATCH] for name, column in whole.items()})
        for at in range(0, size, BATCH)
    ]


def _office(seed: int) -> list[Frame]:
    return office(_BLOCK_S, random.Random(seed), long=True)[:12_000]


def _cost(names: Sequence[str], batches: Sequence[RecordBatch]) -> float:
    engine = HostEngine()
    for name in names:
        engine.add(CATALOGUE[name].query())
    begin = time.process_time()
    for batch in batches:
        engine.process(batch)
    engine.finish()
    return time.process_time() - begin


def correctness() -> dict[str, Any]:
    """Every query on every traffic; a query is correct when it is so on all."""
    wrong: dict[str, list[str]] = {}
    for name, frames in _traffics():
        with tempfile.TemporaryDirectory() as folder, SonataStage(Path(folder)) as stage:
            stage.declare(QUERIES.values())
            stage.play(frames)
            results = stage.finish()
            for query in equal_to_naive(frames, results, stage.base_us):
                wrong.setdefault(query, []).append(name)
    return {"correct_queries": len(CATALOGUE) - len(wrong), "wrong": wrong}


def _traffics() -> Iterator[tuple[str, list[Frame]]]:
    yield "all attacks", mixed(CATALOGUE, seconds=20)
    for name in CATALOGUE:
        rng = random.Random(7)
        yield name, sorted(office(8, rng, long=True) + attack(name, BASE_US + 10_000, rng))
    for name in CAPTURES:
        with Capture(shared_data(f"captures/{name}.pcap")) as capture:
            yield name, [Frame(time_ns // 1000, length, data) for time_ns, length, data in capture]


def reduction(packets: int) -> dict[str, Any]:
    """Packets for each tuple on the host, by query; None where there was no tuple.

    Queries that the switch counts see all packets, together; those that need copies, which cost the host
    what they cost, a tenth.
    """
    found = plan([_request(name) for name in CATALOGUE])
    counted = [name for name in CATALOGUE if found.of(_request(name).identity).in_switch]
    figures: dict[str, dict[str, Any]] = {
        "reduction": {},
        "reduction_packets": {},
        "tuples": {},
        "results": {},
    }
    rates = []
    for names, number in ((counted, packets), ([n for n in CATALOGUE if n not in counted], packets // 10)):
        with tempfile.TemporaryDirectory() as folder, SonataStage(Path(folder)) as stage:
            stage.declare(QUERIES[name] for name in names)
            begin = time.monotonic()
            sent = stage.play(islice(_long_traffic(), number))
            rates.append(round(sent / (time.monotonic() - begin)))
            results = stage.finish()
        for name in names:
            tuples = stage.tuples[name]
            figures["tuples"][name], figures["results"][name] = tuples, len(results[name])
            figures["reduction_packets"][name] = sent
            figures["reduction"][name] = round(sent / tuples, 1) if tuples else None
    return {**figures, "reduction_packets_per_s": rates}


def _request(name: str) -> Request:
    found = request_of(QUERIES[name], CATALOGUE)
    assert found is not None
    return found


def _long_traffic() -> Iterator[Frame]:
    """Minutes of an office, over and over; every sixth minute with one attack of each kind."""
    quiet = [office(_BLOCK_S, random.Random(seed), long=True) for seed in range(_BLOCKS)]
    quiet = [[frame for frame in block if frame.time_us < BASE_US + _BLOCK_S * 10**6] for block in quiet]
    loud = mixed(CATALOGUE, seconds=_BLOCK_S, seed=99)
    for number, block in enumerate(cycle(quiet)):
        chosen = loud if number % _ATTACK_EVERY == _ATTACK_EVERY - 1 else sorted(block)
        shift = number * _BLOCK_S * 10**6
        for frame in chosen:
            yield frame._replace(time_us=frame.time_us + shift)


def responsiveness(rounds: int) -> dict[str, Any]:
    """A key declared under traffic, and 200 that come and go."""
    with tempfile.TemporaryDirectory() as folder, SonataStage(Path(folder)) as stage, stage.traffic(_syns()):
        taken = [stage.first_result(f"new_tcp:threshold={number + 5},window=1s") for number in range(rounds)]
        lost = stage.lost_while_changing(f"new_tcp:dst=198.51.{number}.0/24" for number in range(200))
    return {
        "declare_to_first_result_ms": round(statistics.median(taken) * 1000, 1),
        "declare_to_first_result_worst_ms": round(max(taken) * 1000, 1),
        "lost_packets": lost,
    }


def _syns() -> Iterator[bytes]:
    for number in count():
        yield tcp(f"10.0.{number % 200}.7", "198.51.100.1", 1024 + number % 60_000, 80, 2)


if __name__ == "__main__":
    sys.exit(main())
