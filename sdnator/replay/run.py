"""`sdnator replay` from options to result: check the input, run the passes, summarise."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from sdnator.capture.captures import CaptureError
from sdnator.capture.labels import Labels, LabelsError, read_labels
from sdnator.errors import BadInput
from sdnator.incidents.incident_rows import as_json
from sdnator.plurals import counted
from sdnator.replay.guards import WouldChallenge, would_challenge
from sdnator.replay.laps import REACTION_NS
from sdnator.replay.limits import LimitedPackets, limited_packets
from sdnator.replay.loop import PassResult, Progress, ReplayOptions, ReplayPass, wall_seconds_to_block
from sdnator.replay.packet_accounting import PacketState
from sdnator.replay.passed_in_flight import InFlight
from sdnator.replay.quiet_stretches import laps
from sdnator.replay.summary import attack_figures, auc, block_rows
from sdnator.replay.survey import Survey, survey

MANY_LAPS: Final = 400
"""Rounds through the loop that take longer than the start and end of a dry run, at 25 ms each."""


@dataclass(frozen=True, eq=False)
class ReplayOutcome:
    """All passes of a replay and its figures."""

    survey: Survey
    labels: Labels | None
    dry_run: PassResult | None
    """The pass without mitigation, if there was one."""
    blocking: PassResult | None
    """The pass with mitigation, if there was one."""
    notes: list[str]
    seconds: float
    challenged: WouldChallenge
    """What the guards of the reported pass would have done."""
    limited: LimitedPackets
    """What its rate limits did."""
    reaction_ns: int = REACTION_NS
    """Capture time that could pass from a packet to a remedy for it."""
    discarded: tuple[PassResult, ...] = ()
    """Passes with mitigation that do not count."""

    @property
    def passes(self) -> list[PassResult]:
        """All passes, in their order."""
        return [each for each in (self.dry_run, *self.discarded, self.blocking) if each is not None]

    @property
    def reported(self) -> PassResult:
        """The pass that the figures describe: with mitigation unless it was switched off."""
        chosen = self.blocking or self.dry_run
        assert chosen is not None  # noqa: S101 - there is at least one pass
        return chosen


def prepare(
    capture: Path,
    labels: Path | None,
    options: ReplayOptions,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Survey, Labels | None]:
    """Read capture and labels once; raises BadInput with one clear line."""
    try:
        read = read_labels(labels) if labels is not None else None
        surveyed = survey(capture, progress)
        if read is not None:
            read = read.for_packets(surveyed.packets, cut=surveyed.cut is not None)
    except (CaptureError, LabelsError) as error:
        raise BadInput(str(error)) from error
    if surveyed.packets <= options.training_packets:
        raise BadInput(
            f"{capture}: {surveyed.packets:,} packets, but training alone needs {options.training_packets:,}; "
            f"give a longer capture, or train on fewer with --train N (or --fm-grace N --ad-grace N), "
            f"for instance --train {max(surveyed.packets // 3, 11)}"
        )
    return surveyed, read


def run(
    surveyed: Survey,
    labels: Labels | None,
    options: ReplayOptions,
    *,
    mitigate: bool,
    both: bool,
    progress: Callable[[str], Progress] | None = None,
) -> ReplayOutcome:
    """Run one pass, or two: first a dry run, then with blocking.

    Two if `both` are wanted, or if the dry run saves more time than it takes, because it shows where the pass with
    blocking has to keep up.  Where it was wrong about that, the pass with blocking is made again.

    Raises:
        PipelineError: a part failed.
    """
    begun = time.monotonic()
    watch = frozenset[int]()
    if labels is not None and bool(labels.attack.any()):
        watch = frozenset({int(np.argmax(labels.attack))})

    def one_pass(
        title: str,
        *,
        mitigating: bool,
        seen: PassResult | None = None,
        foresees: bool = False,
        gives_up: bool = False,
    ) -> PassResult:
        replay = ReplayPass(
            surveyed,
            options,
            mitigate=mitigating,
            watch=watch,
            dry_run=seen,
            foresees=foresees,
            gives_up=gives_up,
        )
        return replay.run(progress(title) if progress is not None else None)

    first = both or not mitigate or _looks_ahead(surveyed, options)
    dry_run = one_pass("dry run", mitigating=False) if first else None
    notes = surveyed.notes()
    blocking, discarded = None, list[PassResult]()
    trusts = _trusts(dry_run, options) if mitigate else []
    for place, (seen, foresees) in enumerate(trusts):
        title = "with blocking" if not place else f"again, {place + 1}"
        is_last = place + 1 == len(trusts)
        blocking = one_pass(title, mitigating=True, seen=seen, foresees=foresees, gives_up=not is_last)
        if is_last or not blocking.overtaken:
            break
        notes.append(
            f"the dry run was wrong about where nothing is decided: {counted(blocking.overtaken, 'decision')} would have "
            "taken effect late, so the pass with blocking was made again and held packets back more often"
        )
        discarded.append(blocking)
        _set_aside(options)
    if options.model is not None:
        notes.append(f"no training in this replay: the model is {options.model}")
    if options.switch != "embedded":
        notes.append(
            f"packets have the capture's times, but the meters and idle time-outs of switch {options.switch} run on its "
            "own clock"
        )
    reported = blocking or dry_run
    assert reported is not None  # noqa: S101 - there is at least one pass
    challenged = would_challenge(surveyed.path, surveyed.packets, reported.decisions, reported.handshakes)
    if challenged.by_guard:
        notes.append(
            "the clients of a capture cannot answer a challenge: guards were decided, not set, and their SYNs passed"
        )
    limited = limited_packets(surveyed.path, surveyed.packets, reported.decisions)
    return ReplayOutcome(
        surveyed,
        labels,
        dry_run,
        blocking,
        notes,
        time.monotonic() - begun,
        challenged,
        limited,
        options.reaction_ns,
        tuple(discarded),
    )


def _trusts(dry_run: PassResult | None, options: ReplayOptions) -> list[tuple[PassResult | None, bool]]:
    """What a pass with blocking believes of the dry run, and the one after it if that was wrong.

    Returns:
        The dry run or None, and whether it foretells anything behind the first block.
    """
    foresees = options.unhindered and not options.reproducible
    found: list[tuple[PassResult | None, bool]] = [] if dry_run is None else [(dry_run, False)]
    return [*([(dry_run, True)] if found and foresees else []), *found, (None, False)]


def _set_aside(options: ReplayOptions) -> None:
    """What a pass left that does not count, out of the way of the pass that does."""
    if options.keep is not None:
        with suppress(OSError):  # there is one from an earlier replay
            (options.keep / "with-blocking").rename(options.keep / "with-blocking-discarded")


def _looks_ahead(surveyed: Survey, options: ReplayOptions) -> bool:
    """Whether a dry run before the pass with blocking pays."""
    tested = surveyed.time_ns[options.training_packets :]
    return options.unhindered and laps(tested, options.reaction_ns) >= MANY_LAPS


def figures(outcome: ReplayOutcome) -> dict[str, Any]:
    """The JSON object of `sdnator replay --json`."""
    result = outcome.reported
    flight = result.flight
    trained, scored = flight.count(PacketState.TRAIN), flight.count(PacketState.SCORED)
    incidents = result.last_incidents()
    dropped = flight.state == PacketState.DROPPED
    sent = result.confirmed_sent
    in_flight = InFlight(outcome.survey, result.decisions, result.confirmations, sent, dropped)
    blocks = block_rows(
        outcome.survey, result.decisions, result.confirmations, flight.first_arrival, in_flight
    )
    challenged = outcome.challenged.packets & ~dropped
    limited = outcome.limited.seen & dropped
    first_attack = None
    attack: dict[str, Any] = {}
    if outcome.labels is not None:
        attack = attack_figures(
            outcome.survey, outcome.labels, flight, blocks[0] if blocks else None, limited
        )
        first_attack = attack["first_attack_packet"]
        attack["attack_would_be_challenged"] = int((challenged & outcome.labels.attack).sum())
    capture_seconds = attack.pop("time_to_block_capture_s", None)
    time_to_block = (
        {"capture": capture_seconds, "wall": wall_seconds_to_block(result, first_attack)}
        if blocks and attack
        else None
    )
    return {
        "capture": str(outcome.survey.path),
        "mitigation": result.mitigate,
        "packets_in": flight.sent,
        "packets_scored": trained + scored,
        "packets_dropped": flight.count(PacketState.DROPPED) - result.uncounted_drops,
        "packets_limited": int(limited.sum()),
        "packets_would_be_limited": int(outcome.limited.would.sum()),
        "passed_in_flight": int(in_flight.packets.sum()),
        "most_in_flight": max(in_flight.of_all.values(), default=0),
        "reaction_s": outcome.reaction_ns / 1e9,
        "packets_not_copied": flight.count(PacketState.NOT_COPIED),
        "packets_would_be_challenged": int(challenged.sum()),
        "packets_lost": max(flight.in_flight + result.uncounted_drops, result.lost_on_the_way),
        "training_packets": trained,
        "alerts": len(result.alerts),
        "blocks": blocks,
        "incidents": [as_json(each) for each in incidents],
        "incidents_mitigated": sum(each.mitigated for each in incidents),
        "guards": outcome.challenged.rows(outcome.survey.time_ns),
        "limits": outcome.limited.rows(outcome.survey.time_ns, dropped),
        "first_alert_packet": min((alert.first_packet for alert in result.alerts), default=None),
        "first_block_packet": blocks[0]["packet"] if blocks else None,
        "time_to_block_s": time_to_block,
        **attack,
        "auc": auc(outcome.dry_run.flight, outcome.labels) if outcome.dry_run and outcome.labels else None,
        "seconds": round(outcome.seconds, 3),
        "packets_per_second": round(flight.sent / result.seconds, 1) if result.seconds else None,
        "notes": outcome.notes,
    }
