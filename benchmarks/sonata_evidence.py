"""Evidence of queries on real attacks behind benign traffic: `python -m benchmarks.sonata_evidence --json FILE`.

Each capture of the shared data is put behind the 38,363 real benign packets; the queries learn from the first
12,001 of them.  Host's operators alone: no switch, no clock but the capture's.

benign_evidence: pieces of evidence in the benign part after training.  by_attack: for each query that says
anything, nats in all and seconds of capture time from the attack's first packet to the first evidence.
"""

import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from apps.evidence import Evidence, TrainingState
from apps.sonata_adapter.control import Control, Written
from apps.sonata_adapter.evidence.evidence_queries import EVIDENCE_PREFIX, EvidenceQueries
from apps.sonata_adapter.planner.placement import SwitchLimits
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.results import QueryResult
from benchmarks import measure
from benchmarks.data_folder import add_data_option, data_file
from due import RecordBatch
from sdnator.capture.captures import Capture
from sdnator.cli.queries_run import captured
from sdnator.datasets.rebuild import rebuild
from sdnator.datasets.splice import splice

TRAINING: Final = 12_001
CAPTURES: Final = (
    "synflood_spoofed.pcap",
    "synflood_one_source.pcap",
    "ssh_guessing.pcap",
    "ftp_bruteforce.pcap",
    "ps-tcp_ack.pcap",
    "hs-tcp_synPingSweepRand.pcapng",
    "hs-icmpScan.pcap",
    "hs-udpScan.pcap",
    "na-arpSpoofing.pcap",
    "slips-test8-malicious.pcap",
    "slips-test12-icmp-portscan.pcap",
)
_BATCH: Final = 500
_GAP_NS: Final = 1_000_000_000
_SOON_S: Final = 5.0
_SWITCH: Final = "s1"


def main(argv: Sequence[str] | None = None) -> int:
    """Run all captures, print a table, write the figures."""
    parser = measure.arguments("sonata_evidence", __doc__, rounds=1)
    parser.add_argument("--captures", nargs="+", choices=CAPTURES, default=CAPTURES)
    add_data_option(parser)
    chosen = parser.parse_args(argv)
    figures: dict[str, Any] = {"machine": measure.machine(), "benign_evidence": {}, "by_attack": {}}
    with tempfile.TemporaryDirectory() as folder:
        benign = Path(folder) / "benign.pcap"
        rebuild(data_file(chosen.data, "kitsune/mirai_38k.tsv.gz"), benign)
        for name in chosen.captures:
            whole = Path(folder) / "whole.pcap"
            splice(benign, data_file(chosen.data, f"captures/{name}"), whole, gap_ns=_GAP_NS)
            found = evidence_of(whole)
            first_us = (_last_ns(benign) + _GAP_NS) // 1000
            quiet = [each for each in found if each[1].event_time < first_us * 1000]
            figures["benign_evidence"] |= _summary(quiet, first_us)
            figures["by_attack"][name] = _summary([each for each in found if each not in quiet], first_us)
            print(f"{name:34} {figures['by_attack'][name]}")
    print(f"{'benign part':34} {figures['benign_evidence']}")
    measure.write_json(chosen.json, figures)
    return 0


def evidence_of(capture: Path, names: Sequence[str] = tuple(CATALOGUE)) -> list[tuple[str, Evidence]]:
    """All evidence that queries find in a capture, trained on its first packets, with the keys."""
    # with one bit, every packet is copied; the operators filter them
    control, queries = Control(CATALOGUE, limits=SwitchLimits(bits=1, stages=0)), EvidenceQueries()
    queries.want([f"{EVIDENCE_PREFIX}.{name}" for name in names], CATALOGUE)
    found: list[tuple[str, Evidence]] = []

    def take(written: Iterable[Written]) -> None:
        results = [(key, one.switch, one.output) for one in written for key in one.keys]
        found.extend(queries.take((k, s, each) for k, s, each in results if isinstance(each, QueryResult)))

    seen, running, begin_us = 0, queries.requests, 0
    control.want((), running)
    for base_us, batch in batches_of(capture):
        control.switch(_SWITCH, base_us)
        begin_us = begin_us or int(batch["time_us"][0])
        take(control.packets(_SWITCH, "q0", batch, float(seen)))
        seen += len(batch)
        now_us = int(batch["time_us"][-1])
        if seen <= TRAINING:
            found += queries.train("kitsune", _state(seen, begin_us, now_us))
        found += queries.hear(now_us)
        if queries.requests != running:
            running = queries.requests
            control.want((), running)
    take(control.finish())
    return found


def _last_ns(capture: Path) -> int:
    with Capture(capture) as frames:
        return max(frame.time_ns for frame in frames)


def batches_of(capture: Path) -> Iterator[tuple[int, RecordBatch]]:
    """Clock zero and packets, in parts one of which ends where training does."""
    seen = 0
    for piece in captured([capture]):
        rows = np.arange(len(piece.batch))
        at = [row for row in rows.tolist() if (seen + row) % _BATCH == 0 or seen + row == TRAINING]
        for part in np.split(rows, at):
            if len(part):
                yield piece.base_us, piece.batch.take(part)
        seen += len(rows)


def _state(seen: int, begin_us: int, now_us: int) -> TrainingState:
    return TrainingState(
        packets=seen,
        wanted=TRAINING,
        done=seen == TRAINING,
        seconds=(now_us - begin_us) / 1e6,
        senders=0,
        event_time=now_us * 1000,
    )


def _summary(found: Iterable[tuple[str, Evidence]], first_us: int) -> dict[str, Any]:
    """By query: how much was said, how strong it was in all, when it began, and what was said first."""
    by_query: dict[str, list[Evidence]] = {}
    for key, evidence in found:
        by_query.setdefault(key.rpartition(".")[2], []).append(evidence)
    return {
        query: {
            "items": len(said),
            "nats": round(sum(each.nats for each in said), 1),
            "first_s": round(said[0].event_time / 1e9 - first_us / 1e6, 3),
            "nats_in_5_s": round(
                sum(each.nats for each in said if each.event_time / 1e9 - first_us / 1e6 <= _SOON_S), 1
            ),
            "first": said[0].text,
        }
        for query, said in sorted(by_query.items())
    }


if __name__ == "__main__":
    sys.exit(main())
