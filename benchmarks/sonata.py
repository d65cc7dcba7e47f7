"""Sonata queries, measured: `python -m benchmarks.sonata --json FILE`.

correct_queries: queries of the paper whose results, switch and host together, equal those of a naive evaluator on
generated attacks and on real captures; correct_own_queries: the same of those that the paper does not have; estimates: results that call themselves so.  reduction: packets
for each tuple that reached the host, on --packets packets in two runs, since the switch has not room for
all queries at once; for zorro and slowloris outside attacks.  two_tuples_a_result: on all of them, whether
no more tuples came than that and those of keys without a cell (overflow).  dns_share: packets that are DNS,
all of which dns_reflection looks at on the host.
host_tuples_per_s: filter, distinct and reduce on one core.
all_queries_cost_ratio: processor time of the paper's eleven together over that of the dearest alone.
window_200ms_delay_ms: from the end of a window of 200 ms to the result that is known then only.
declare_to_first_result_ms: from writing a key to its first result, windows of one second, busy network.
lost_packets: not forwarded while 200 queries came and went.  Real processes, embedded switch.
correct_alone, correct_pairs, correct_together: sets of the paper's eleven that are all right (of 11, of 55, and queries
of 11), in one switch (benchmarks.sonata_sets); in_switch_alone, in_switch_together: those that the switch counts.
benign_reports, auto_recall: at `threshold=auto` (benchmarks.sonata_auto).
host_cpu_per_million_packets: with nothing wanted, the eleven, and copies of all packets; host_cpu_ratio: of the latter
two (benchmarks.sonata_cost).
bmv2: with `--only bmv2`, which needs root: the queries with all attacks through BMv2, at its own times.
"""

import random
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.query.catalogue import CATALOGUE, OUR_OWN, PAPER
from benchmarks import measure
from benchmarks.data_folder import add_data_option, data_file
from benchmarks.sonata_auto import benign_figures, recall_figures
from benchmarks.sonata_cost import cost_figures
from benchmarks.sonata_sets import set_figures
from benchmarks.sonata_stage import QUERIES, SonataStage, equal_to_naive
from benchmarks.sonata_traffic import ATTACKS, MINUTE_PACKETS, FrameColumns, traffic
from due import RecordBatch
from sdnator.capture.captures import Capture
from sdnator.testing.query_traffic import BASE_US, TimedFrame, attack, batch_of, mixed, office, tcp

_PARTS = ("auto", "sets", "cost", "host", "correctness", "reduction", "responsiveness", "bmv2")
CAPTURES = ("synflood_spoofed", "synflood_one_source", "ssh_guessing", "ftp_bruteforce")
BATCH = 32_768
_BLOCK_S = 60
_SECOND = ("syn_flood", "incomplete_flows", "slowloris", "dns_tunnel", "zorro", "dns_reflection")
"""Queries of the second run for `reduction`."""
_OUTSIDE = ("slowloris", "zorro")
"""Queries whose reduction counts outside attacks: what an attack is can be told from its packets only."""
_DENSE = 10_000
"""Packets a second that may come together when traffic is played faster than it came."""
_FASTER = 8.0
"""How much faster than it came that run plays its traffic: the cells of a window can be read after it."""
_COST_ROUNDS = 3
_EXACT = 4.0
"""The same where every result counts: 0.75 s to read the cells of a window of 3 s."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run all, print a table, write the figures."""
    parser = measure.arguments("sonata", __doc__, rounds=5)
    parser.add_argument(
        "--only", nargs="+", choices=_PARTS, default=_PARTS[:-1], help="parts of it; not bmv2"
    )
    traffics = ("all attacks", *CATALOGUE, *CAPTURES)
    parser.add_argument("--traffic", nargs="+", choices=traffics, default=traffics, help="of correctness")
    parser.add_argument("--packets", type=int, default=3_600_000, help="of the run for `reduction`")
    add_data_option(parser)
    chosen = parser.parse_args(argv)
    figures: dict[str, Any] = {"machine": measure.machine()}
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "auto": lambda: benign_figures(chosen.data) | recall_figures(),
        "sets": set_figures,
        "cost": lambda: cost_figures(min(chosen.rounds, _COST_ROUNDS)),
        "host": lambda: host_figures(chosen.rounds),
        "correctness": lambda: correctness(chosen.traffic, chosen.data),
        "reduction": lambda: reduction(int(chosen.packets * chosen.scale)),
        "responsiveness": lambda: responsiveness(chosen.rounds),
        "bmv2": bmv2,
    }
    for name in chosen.only:
        begin = time.monotonic()
        figures |= parts[name]()
        figures.setdefault("seconds", {})[name] = round(time.monotonic() - begin, 1)
        measure.write_json(chosen.json, figures)  # what is measured stays if a later part fails
    for name, value in figures.items():
        print(f"{name:28} {value}")
    return 0


def host_figures(rounds: int) -> dict[str, Any]:
    """The host's operators alone, in processor time, peers interleaved."""
    batches = _dense()
    packets = sum(map(len, batches))
    peers = {name: (lambda name=name: _cost([name], batches)) for name in CATALOGUE}
    costs = measure.interleaved({**peers, "all": lambda: _cost(PAPER, batches)}, rounds)
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


def _office(seed: int) -> list[TimedFrame]:
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


def correctness(traffics: Sequence[str], data: Path) -> dict[str, Any]:
    """Every query on every traffic; a query is correct when it is so on all."""
    wrong: dict[str, list[str]] = {}
    estimates: Counter[str] = Counter()
    late_reads = 0
    for name, frames in _traffics(traffics, data):
        with tempfile.TemporaryDirectory() as folder, SonataStage(Path(folder)) as stage:
            stage.declare(QUERIES.values())
            stage.play(frames, faster=_pace(frames))
            results = stage.finish()
            for query in equal_to_naive(frames, results, stage.base_us):
                wrong.setdefault(query, []).append(name)
            late_reads += stage.late_reads
            estimates.update(query for query, each in results.items() for one in each if not one["exact"])
    return {
        **_correct(wrong),
        "wrong": wrong,
        "estimates": dict(estimates),
        "late_reads": late_reads,
    }


def _pace(frames: Sequence[TimedFrame]) -> float:
    """How many times as fast as it came traffic is played: dense traffic as it came."""
    densest = max(Counter(frame.time_us // 10**6 for frame in frames).values())
    return min(_EXACT, max(1.0, _DENSE / densest))


def bmv2() -> dict[str, Any]:
    """Every query on all attacks through BMv2, whose clock stamps the frames."""
    frames = mixed(CATALOGUE, seconds=20)
    with tempfile.TemporaryDirectory() as folder, SonataStage(Path(folder), "bmv2") as stage:
        stage.declare(QUERIES.values())
        stage.note_times()
        stage.play(frames, faster=1)
        stamped = stage.stamped(frames)
        results = stage.finish()
        wrong = equal_to_naive(stamped, results, stage.base_us, zero=stage.base_us)
    found = {name: len(each) for name, each in results.items()}
    return {"bmv2": {**_correct(wrong), "wrong": wrong, "results": found}}


def _correct(wrong: Collection[str]) -> dict[str, int]:
    """How many queries are never wrong, the paper's and ours apart."""
    return {
        "correct_queries": sum(name not in wrong for name in PAPER),
        "correct_own_queries": sum(name not in wrong for name in OUR_OWN),
    }


def _traffics(names: Sequence[str], folder: Path) -> Iterator[tuple[str, list[TimedFrame]]]:
    for name in names:
        if name in CAPTURES:
            with Capture(data_file(folder, f"captures/{name}.pcap")) as capture:
                yield name, [TimedFrame(time_ns // 1000, length, data) for time_ns, length, data in capture]
        elif name in CATALOGUE:
            rng = random.Random(7)
            yield name, sorted(office(8, rng, long=True) + attack(name, BASE_US + 10_000, rng))
        else:
            yield name, mixed(CATALOGUE, seconds=20)


def reduction(packets: int) -> dict[str, Any]:
    """Packets for each tuple on the host, by query; None where there was no tuple.

    For `_OUTSIDE` only the part without attacks counts, for the others all.  The second run has
    `_SECOND`: their counting entries and those of the others do not fit into the switch together.
    """
    minutes = -(-packets // MINUTE_PACKETS)
    parts = traffic(minutes)
    figures: dict[str, Any] = {
        "reduction": {},
        "reduction_packets": {},
        "tuples": {},
        "results": {},
        "overflow": {},
        "two_tuples_a_result": {},
        "reduction_attacks": minutes * ATTACKS,
        "reduction_packets_per_s": [],
    }
    first = [name for name in PAPER if name not in _SECOND]
    # nothing is read from the switch for the first ones
    for names, faster in ((first, 0.0), (list(_SECOND), _FASTER)):
        with tempfile.TemporaryDirectory() as folder, SonataStage(Path(folder)) as stage:
            stage.declare(QUERIES[name] for name in names)
            _count(stage, names, parts, faster, figures)
    return figures


def _count(
    stage: SonataStage,
    names: list[str],
    parts: tuple[FrameColumns, FrameColumns],
    faster: float,
    figures: dict[str, Any],
) -> None:
    loud, rest = parts
    begin = time.monotonic()
    stage.play(loud, faster=faster, zero=BASE_US)
    before = stage.settle()
    stage.play(rest, faster=faster, zero=BASE_US)
    after = stage.settle()
    sent, quiet = len(loud) + len(rest), len(rest)
    figures["reduction_packets_per_s"].append(round(sent / (time.monotonic() - begin)))
    results = stage.finish()
    for name in names:
        outside = quiet, after[name] - before[name]
        seen, n = outside if name in _OUTSIDE else (sent, stage.tuples[name])
        figures["tuples"][name], figures["results"][name] = n, len(results[name])
        figures["reduction_packets"][name] = seen
        over = figures["overflow"][name] = stage.overflow[name]
        figures["two_tuples_a_result"][name] = stage.tuples[name] <= 2 * len(results[name]) + over
        figures["reduction"][name] = round(seen / n, 1) if n else None
    if "dns_reflection" in names:
        figures["dns_share"] = round(figures["tuples"]["dns_reflection"] / sent, 4)


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
