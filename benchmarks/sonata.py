"""Sonata queries, measured: `python -m benchmarks.sonata --json FILE`.

correct_queries: queries whose results, switch and host together, equal those of a naive evaluator on
generated attacks and on real captures.  reduction: packets for each tuple that reached the host, on
--packets packets in two runs, since the switch has not room for all queries at once; for zorro and
slowloris outside attacks.  host_tuples_per_s: filter, distinct and reduce on one core.
all_queries_cost_ratio: processor time of all eleven together over that of the dearest alone.
window_200ms_delay_ms: from the end of a window of 200 ms to the result that is known then only.
declare_to_first_result_ms: from writing a key to its first result, windows of one second, busy network.
lost_packets: not forwarded while 200 queries came and went.  Real processes, embedded switch.
"""

import random
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from apps.sonata_adapter.catalogue import CATALOGUE
from apps.sonata_adapter.engine import HostEngine
from benchmarks import measure
from benchmarks.sonata_stage import QUERIES, SonataStage, equal_to_naive
from benchmarks.sonata_traffic import ATTACKS, MINUTE_PACKETS, minutes
from due import RecordBatch
from sdnator.captures import Capture
from tests.apps.sonata_adapter.traffic import BASE_US, Frame, attack, batch_of, mixed, office, tcp
from tests.requirements import shared_data

CAPTURES = ("synflood_spoofed", "synflood_one_source", "ssh_guessing", "ftp_bruteforce")
BATCH = 32_768
_BLOCK_S = 60
_SECOND = ("syn_flood", "incomplete_flows", "slowloris", "dns_tunnel", "zorro", "dns_reflection")
"""Queries of the second run for `reduction`."""
_OUTSIDE = ("slowloris", "zorro")
"""Queries whose reduction counts outside attacks: what an attack is can be told from its packets only."""
_FASTER = 8.0
"""Replays are faster than the traffic, but so slow that the cells of a window can be read after it."""


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
            stage.play(frames, faster=_FASTER)
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

    For `_OUTSIDE` only the parts without attacks count, for the others all.  The second run has
    `_SECOND`: their counting entries and those of the others do not fit into the switch together.
    """
    figures: dict[str, Any] = {
        "reduction": {},
        "reduction_packets": {},
        "tuples": {},
        "results": {},
        "reduction_attacks": 0,
        "reduction_packets_per_s": [],
    }
    for names in ([name for name in CATALOGUE if name not in _SECOND], list(_SECOND)):
        with tempfile.TemporaryDirectory() as folder, SonataStage(Path(folder)) as stage:
            stage.declare(QUERIES[name] for name in names)
            _count(stage, names, packets, figures)
    return figures


def _count(stage: SonataStage, names: list[str], packets: int, figures: dict[str, Any]) -> None:
    tuples = dict.fromkeys(("quiet", "all"), dict.fromkeys(CATALOGUE, 0))
    quiet = sent = attacks = 0
    begin = time.monotonic()
    for loud, rest in minutes(1 + packets // (MINUTE_PACKETS - 1)):
        sent += stage.play(loud, faster=_FASTER, zero=BASE_US)
        attacks += ATTACKS
        before = stage.settle()
        part = stage.play(rest, faster=_FASTER, zero=BASE_US)
        after = stage.settle()
        sent, quiet = sent + part, quiet + part
        tuples["quiet"] = {name: n + after[name] - before[name] for name, n in tuples["quiet"].items()}
        tuples["all"] = after
        if sent >= packets:
            break
    figures["reduction_packets_per_s"].append(round(sent / (time.monotonic() - begin)))
    figures["reduction_attacks"] = attacks
    results = stage.finish()
    for name in names:
        seen, n = (quiet, tuples["quiet"][name]) if name in _OUTSIDE else (sent, stage.tuples[name])
        figures["tuples"][name], figures["results"][name] = n, len(results[name])
        figures["reduction_packets"][name] = seen
        figures["reduction"][name] = round(seen / n, 1) if n else None


def responsiveness(rounds: int) -> dict[str, Any]:
    """A key declared under traffic, and 200 that come and go."""
    with tempfile.TemporaryDirectory() as folder, SonataStage(Path(folder)) as stage, stage.traffic(_syns()):
        delays = stage.delay_after_window("syn_flood:window=200ms", 10 * rounds)
        taken = [stage.first_result(f"new_tcp:threshold={number + 5},window=1s") for number in range(rounds)]
        lost = stage.lost_while_changing(f"new_tcp:dst=198.51.{number}.0/24" for number in range(200))
    return {
        "declare_to_first_result_ms": round(statistics.median(taken) * 1000, 1),
        "declare_to_first_result_worst_ms": round(max(taken) * 1000, 1),
        "window_200ms_delay_ms": round(statistics.median(delays) * 1000, 1),
        "window_200ms_delay_worst_ms": round(max(delays) * 1000, 1),
        "lost_packets": lost,
    }


def _syns() -> Iterator[bytes]:
    for number in count():
        yield tcp(f"10.0.{number % 200}.7", "198.51.100.1", 1024 + number % 60_000, 80, 2)


if __name__ == "__main__":
    sys.exit(main())
