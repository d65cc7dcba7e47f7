"""SYN floods end to end: real packets, a real TCP service, network namespaces (root).

Client success and half-open connections are measured with the guard armed beforehand;
`time_to_mitigate_ms` without it, from the flood's first frame to the rule confirmed by the switch, where
the firewall has to find the flood itself (`detected` has that run's success from 7 s after the rule:
the backlog's own 7 s are waited out, no half-open connection is reset).
"""

import statistics
import sys
from collections.abc import Sequence
from typing import Any

from benchmarks.measure import arguments, machine, table, write_json
from sdnator.syn_flood import SynFloodOptions, SynFloodResult, run_syn_flood
from sdnator.syn_flood_frames import Sources

KINDS: dict[str, Sources] = {
    "one_source": "one",
    "hundred_sources": "hundred",
    "spoofed": "spoofed",
    "spoofed_repeating": "repeating",
}
FIELDS = (
    "client_success_unprotected",
    "known_client_success",
    "new_client_success",
    "new_connect_ms_p50",
    "half_open_peak",
    "time_to_mitigate_ms",
    "entries_peak",
)
DETECTED = ("known_client_success", "new_client_success", "time_to_mitigate_ms")


def measure(sources: Sources, version: int, rounds: int) -> dict[str, Any]:
    """Medians over the rounds of one kind of flood; `void` counts runs that say nothing."""
    armed = [_run(sources, version, armed=True) for _ in range(rounds)]
    unarmed = [_run(sources, version, armed=False) for _ in range(rounds)]
    figures = {name: _median([getattr(result, name) for result in armed]) for name in FIELDS}
    figures["guard_armed_first_challenge_ms"] = figures["time_to_mitigate_ms"]
    found = {name: _median([getattr(result, name) for result in unarmed]) for name in DETECTED}
    figures["time_to_mitigate_ms"] = found["time_to_mitigate_ms"]
    figures["entries_peak"] = max(result.entries_peak for result in armed + unarmed)
    return figures | {"detected": found, "void": sum(bool(result.void) for result in armed + unarmed)}


def _run(sources: Sources, version: int, *, armed: bool) -> SynFloodResult:
    seconds = 10.0 if armed else 14.0
    result = run_syn_flood(SynFloodOptions(sources=sources, version=version, armed=armed, seconds=seconds))
    seen = f"known {result.known_client_success}, new {result.new_client_success}"
    mitigated = f"mitigated after {result.time_to_mitigate_ms} ms"
    print(f"{sources}, armed {armed}: {result.void or f'{seen}, {mitigated}'}", file=sys.stderr)
    return result


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def main(argv: Sequence[str] | None = None) -> int:
    """Run all kinds; 1 where a run was void."""
    parser = arguments("syn_flood", __doc__, rounds=1)
    parser.add_argument("--ipv6", action="store_true", help="IPv6 instead of IPv4")
    parser.add_argument(
        "--only", choices=sorted(KINDS), action="append", help="only this kind; may be repeated"
    )
    chosen = parser.parse_args(argv)
    before = machine()
    figures: dict[str, Any] = {
        name: measure(kind, 6 if chosen.ipv6 else 4, chosen.rounds)
        for name, kind in KINDS.items()
        if not chosen.only or name in chosen.only
    }
    table(("flood", *FIELDS), [(name, *(each[field] for field in FIELDS)) for name, each in figures.items()])
    void = sum(each["void"] for each in figures.values())
    write_json(chosen.json, {**figures, "machine": before, "rounds": chosen.rounds})
    return 1 if void else 0


if __name__ == "__main__":
    sys.exit(main())
