"""How many messages a second reach callbacks in another process: DUE, raw redis-py, os-ken.

`python -m benchmarks.updates --json FILE`.  All peers use one embedded server over a Unix socket and take
turns.  os-ken's event API hands objects from app to app inside one process, so it is the bound that a
controller without distribution sets; `benchmarks.osken` says how to have it.
"""

import sys
import tempfile
from collections.abc import Sequence
from statistics import median

from benchmarks import osken
from benchmarks.measure import arguments, bars, interleaved, machine, table, write_json
from benchmarks.pairs import (
    producer_cost,
    raw_producer_cost,
    run_due,
    run_one_by_one,
    run_pipeline100,
    run_raw_frames,
    run_records,
)
from benchmarks.secured_updates import secured_figures
from due.drivers.embedded_redis import EmbeddedServer

SIZES = (100, 1000, 10_000)
COUNTS = {
    "due": {100: 600_000, 1000: 300_000, 10_000: 30_000},
    "pipeline100": {100: 100_000, 1000: 80_000, 10_000: 20_000},
    "one_by_one": {100: 10_000, 1000: 10_000, 10_000: 6_000},
    "raw_frames": {100: 600_000, 1000: 300_000, 10_000: 30_000},
}
RUNNERS = {
    "due": run_due,
    "pipeline100": run_pipeline100,
    "one_by_one": run_one_by_one,
    "raw_frames": run_raw_frames,
}
COST_OF = {"due": producer_cost, "raw": raw_producer_cost}
ROWS, BATCHES = 10_000, 1500
WHY_NOT_RAW = (
    "the rest against raw frames: DUE numbers and stamps each message, and calls back for each with an Item"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, write."""
    parser = arguments("updates", __doc__, rounds=3)
    parser.add_argument(
        "--secured", action="store_true", help="compare instead DUE without and with rights and TLS"
    )
    options = parser.parse_args(argv)
    if options.secured:
        costs = secured_figures(options.rounds, options.scale)
        write_json(options.json, {"machine": machine(), "rounds": options.rounds, **costs})
        return 0
    figures: dict[str, object] = {"machine": machine(), "rounds": options.rounds}
    rates: dict[str, dict[str, float]] = {name: {} for name in RUNNERS}
    with tempfile.TemporaryDirectory() as folder, EmbeddedServer(folder) as server:
        for size in SIZES:
            peers = {
                name: lambda name=name, size=size: RUNNERS[name](
                    server.url, size, _hundreds(COUNTS[name][size] * options.scale)
                )
                for name in RUNNERS
            }
            for name, rate in interleaved(peers, options.rounds).items():
                rates[name][str(size)] = rate
        records = interleaved(
            {"records": lambda: run_records(server.url, ROWS, max(10, int(BATCHES * options.scale)))},
            options.rounds,
        )["records"]
        producers = _costs(server.url, int(200_000 * options.scale), 4 * options.rounds)
    os_ken = {str(size): osken.events_per_second(size) for size in SIZES} if osken.available() else None
    for name in RUNNERS:
        figures[f"{name}_msgs_per_s"] = rates[name]
    figures["osken_events_per_s"] = os_ken
    figures["ratio_vs_pipeline100"] = {s: rates["due"][s] / rates["pipeline100"][s] for s in rates["due"]}
    figures["ratio_vs_raw_frames"] = {s: rates["due"][s] / rates["raw_frames"][s] for s in rates["due"]}
    figures["records_per_s"] = records
    figures["records_vs_pipeline100"] = records / rates["pipeline100"]["100"]
    figures["producer_cpu_s_per_million_by_consumers"] = {
        n: median(found) for n, found in producers["due"].items()
    }
    figures["three_consumers_extra"] = _extra(producers["due"])
    figures["three_consumers_extra_raw"] = _extra(producers["raw"])
    _show(rates, os_ken, figures)
    write_json(options.json, figures)
    return 0


def _costs(url: str, count: int, rounds: int) -> dict[str, dict[str, list[float]]]:
    """CPU seconds of the producer per million messages by peer and number of consumers.

    Turn and turn about: in every other round the three consumers come first.
    """
    costs: dict[str, dict[str, list[float]]] = {name: {"1": [], "3": []} for name in COST_OF}
    for number in range(rounds):
        for name, cost in COST_OF.items():
            for consumers in ("1", "3") if number % 2 else ("3", "1"):
                costs[name][consumers].append(cost(url, 1000, count, int(consumers)))
    return costs


def _extra(costs: dict[str, list[float]]) -> float:
    """The share by which three consumers cost more than one: the median of the rounds' ratios."""
    return median(three / one for one, three in zip(costs["1"], costs["3"], strict=True)) - 1


def _hundreds(count: float) -> int:
    return max(100, int(count) // 100 * 100)


def _show(
    rates: dict[str, dict[str, float]], os_ken: dict[str, float] | None, figures: dict[str, object]
) -> None:
    ratio, frames = figures["ratio_vs_pipeline100"], figures["ratio_vs_raw_frames"]
    assert isinstance(ratio, dict)
    assert isinstance(frames, dict)
    table(
        ["bytes", *RUNNERS, "os-ken", "DUE / pipeline", "DUE / raw frames"],
        [
            [
                size,
                *(rates[name][size] for name in RUNNERS),
                os_ken[size] if os_ken else "-",
                ratio[size],
                frames[size],
            ]
            for size in rates["due"]
        ],
    )
    print(f"\n{WHY_NOT_RAW}")
    if os_ken is None:
        print(osken.ABSENT)
    bars("messages/s of 100 bytes", {name: rates[name]["100"] for name in RUNNERS})
    extra, raw = figures["three_consumers_extra"], figures["three_consumers_extra_raw"]
    print(f"three consumers cost the producer {extra:+.1%} CPU; with redis-py alone {raw:+.1%}")
    bars("records/s", {"record batches": float(str(figures["records_per_s"]))})


if __name__ == "__main__":
    sys.exit(main())
