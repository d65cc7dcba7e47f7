"""The switch: packet-ins, digests, forwarding, entries, blocks; beside bare gRPC and, where it is, BMv2.

`python -m benchmarks.switch --json FILE`; the figures' meaning stands in the docstrings of switch_*.py.
"""

import p4rt  # noqa: F401  # isort: skip  # before anything loads gRPC: it says how gRPC waits

import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks import switch_wire
from benchmarks.measure import arguments, machine, table, write_json
from benchmarks.switch_control import block_latency, entries
from benchmarks.switch_pipeline import figures_of
from benchmarks.switch_streams import bare, packet_in

PAIRS = 9
ROUNDS = 5
BLOCKS = 100
COUNT = 30_000
DIGESTS = 100_000
ENTRIES = 10_000
STEP_S = 1.5
PIPELINE_S = 3.0
PARTS = ("pipeline", "packet-in", "digest", "entries", "block", "wire")


def measure(parts: set[str], rounds: int, scale: float, folder: Path) -> dict[str, Any]:
    """The figures of the parts asked for."""
    figures: dict[str, Any] = {}
    if "pipeline" in parts:
        figures |= figures_of(PIPELINE_S * scale, ROUNDS)
    count = int(COUNT * scale)
    if "packet-in" in parts:
        figures |= packet_in(folder / "packet-in", rounds, count)
        figures["packet_in_pps_without_due"] = bare(folder / "bare", ROUNDS, count, digests=False)
    if "digest" in parts:
        figures["digest_pps"] = bare(folder / "digest", ROUNDS, int(DIGESTS * scale), digests=True)
    if "entries" in parts:
        figures |= entries(folder / "entries", ROUNDS, int(ENTRIES * scale))
    if "block" in parts:
        figures |= block_latency(folder / "block", max(10, int(BLOCKS * scale)))
    if "wire" in parts and switch_wire.possible():
        embedded = switch_wire.wire("embedded", folder / "wire", STEP_S)
        figures["forward_pps"] = embedded["forward_pps"]
        figures["embedded_on_veth"] = embedded
        if switch_wire.bmv2_installed():
            figures["bmv2"] = switch_wire.wire("bmv2", folder / "bmv2", STEP_S)
    return figures


def show(figures: dict[str, Any]) -> None:
    """Print the figures."""
    flat = [(name, value) for name, value in figures.items() if isinstance(value, float | int)]
    table(("figure", "value"), flat)
    if "bmv2" in figures:
        print("\non two veth pairs")
        ours, theirs = figures["embedded_on_veth"], figures["bmv2"]
        table(("figure", "embedded", "BMv2"), [(name, ours[name], theirs[name]) for name in ours])


def main() -> int:
    parser = arguments("switch", __doc__, rounds=PAIRS)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts to measure")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="sdnator-bench-") as folder:
        figures = measure(set(options.only), options.rounds, options.scale, Path(folder))
    show(figures)
    write_json(options.json, {"machine": machine(), **figures})
    return 0


if __name__ == "__main__":
    sys.exit(main())
