"""What must hold of a recorded run under faults: a pure judge of what the probes saw.

The model.  The probes live through every fault, on a disk and with a clock of their own, so nothing excuses them.

    taken by `write` ─► covered by `flush` ─► delivered once, in order      reliable key
                                       └─► in the archive at the end      archived key
    instruction taken and flushed ─► answered ─► done: a decision in the archive ─► an entry in the switch
                                              └─► refused with its cause: no promise, but what is in force can be lifted
    words of the standby pair, and of the controllers, by the time of writing: turns of one instance, never both at once

Delivery is at least once to an app and once to an instance that lives; the reading probe is never killed, so
that a number that it gets twice was delivered again after it was done with it.
What a damaged archive took with it is excused: its operator put a copy there, which has what came before.
The state of the switch is judged after the last fault, when the pipeline has had time to settle.
A frame of a blocked source may pass while the switch is being given its entries again: until `RESTORED_S`
after a fault of switch or controller.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

RESTORED_S = 60.0
"""A switch that was broken holds its entries again after so many seconds."""
LONGEST_OVERLAP_S = 0.3
"""A turn of the other instance shorter than this, between two turns of one, is no failover: that takes longer."""

LONGEST_TURN_S = 1.5
"""The same for controllers, which report once a second: an instance is given up after two seconds of silence."""


@dataclass(frozen=True)
class Violation:
    """One promise that was not kept."""

    kind: str
    detail: str


@dataclass(frozen=True)
class Decided:
    """A decision about an address, as it stands in the archive."""

    id: str
    action: str
    address: str


@dataclass(frozen=True)
class Asked:
    """An instruction that `flush` covered."""

    id: str
    verb: str
    address: str
    at: float = 0.0
    """When that was, in seconds of the run."""


@dataclass(frozen=True)
class Passed:
    """A frame of a source that was blocked and came through."""

    at: float
    address: str


@dataclass(frozen=True)
class Word:
    """A word of the standby pair: when it was written, in seconds, and by which instance."""

    at: float
    speaker: str


@dataclass
class RunRecord:
    """Everything that the probes saw; times are seconds of one clock."""

    acknowledged: int = 0
    """Numbers 0 to this one, not included, were covered by `flush` on the reliable key."""
    delivered: list[int] = field(default_factory=list)
    """Numbers of the reliable key as they came."""
    unwanted: set[int] = field(default_factory=set)
    """Numbers of which `write` said that nobody wants them: promised to nobody."""
    archive_acknowledged: int = 0
    excused: set[int] = field(default_factory=set)
    """Numbers that a damaged archive took with it."""
    forgotten: set[str] = field(default_factory=set)
    """Addresses about which a damaged archive had decisions that its copy has not."""
    archived: list[int] = field(default_factory=list)
    asked: list[Asked] = field(default_factory=list)
    answers: dict[str, bool] = field(default_factory=dict)
    """Whether it was done, by the id of the instruction."""
    decisions: list[Decided] = field(default_factory=list)
    """In the order of the archive."""
    entries: frozenset[str] | None = frozenset()
    """Addresses that the switch drops at the end; None: it did not answer."""
    installed: dict[str, float] = field(default_factory=dict)
    """When the controller confirmed the entry, by address."""
    lifted: dict[str, float] = field(default_factory=dict)
    """When somebody asked for its end, by address."""
    passed: list[Passed] = field(default_factory=list)
    words: list[Word] = field(default_factory=list)
    reports: list[Word] = field(default_factory=list)
    """The same of the controllers, by what they say of the switch."""
    switch_faults: list[float] = field(default_factory=list)
    """When the switch, its controller, or what both hear the firewall by was broken."""
    away: list[str] = field(default_factory=list)
    """Parts that did not run at the end."""


def check(record: RunRecord) -> list[Violation]:
    """All promises that the record breaks; empty: none."""
    return [
        *_delivery(record.acknowledged, record.delivered, record.unwanted),
        *_archive(record.archive_acknowledged, record.archived, record.excused),
        *_instructions(record),
        *_switch(record),
        *_verdicts(record),
        *_actives("standby pair", record.words, LONGEST_OVERLAP_S),
        *_actives("controllers", record.reports, LONGEST_TURN_S),
        *(Violation("part_away", f"{name} did not run at the end") for name in record.away),
    ]


def _delivery(acknowledged: int, delivered: Sequence[int], unwanted: set[int]) -> Iterator[Violation]:
    seen: set[int] = set()
    newest = -1
    for number in delivered:
        if number in seen:
            yield Violation("twice_after_acknowledgement", f"number {number} was delivered again")
        elif number < newest:
            yield Violation("order", f"number {number} was delivered after {newest}")
        seen.add(number)
        newest = max(newest, number)
    yield from _missing("acknowledged_not_delivered", acknowledged, seen | unwanted)


def _archive(acknowledged: int, archived: Sequence[int], excused: set[int]) -> Iterator[Violation]:
    yield from _missing("acknowledged_not_archived", acknowledged, set(archived) | excused)
    if len(archived) != len(set(archived)):
        yield Violation("archived_twice", f"{len(archived) - len(set(archived))} numbers are there twice")


def _missing(kind: str, acknowledged: int, seen: set[int]) -> Iterator[Violation]:
    missing = [number for number in range(acknowledged) if number not in seen]
    if missing:
        yield Violation(kind, f"{len(missing)} of {acknowledged} numbers, the first is {missing[0]}")


def _instructions(record: RunRecord) -> Iterator[Violation]:
    decided = {(each.action, each.address) for each in record.decisions}
    stands = in_force(record.decisions)
    for asked in record.asked:
        if asked.id not in record.answers:
            yield Violation(
                "acknowledged_not_answered", f"{asked.verb} {asked.address} at {asked.at:.1f} s: no answer"
            )
        if asked.address in record.forgotten:
            continue
        if record.answers.get(asked.id) and (asked.verb, asked.address) not in decided:
            yield Violation("acknowledged_not_decided", f"{asked.verb} {asked.address} was answered as done")
        if record.answers.get(asked.id) is False and asked.verb == "unblock" and asked.address in stands:
            yield Violation(
                "not_lifted", f"unblock {asked.address} at {asked.at:.1f} s was refused, and it is in force"
            )


def in_force(decisions: Sequence[Decided]) -> frozenset[str]:
    """The addresses that are to be dropped: those with a block that nothing has lifted, in whatever order the archive has
    both, since clocks of writers jump."""
    lifted = {each.id for each in decisions if each.action != "block"}
    return frozenset(each.address for each in decisions if each.action == "block" and each.id not in lifted)


def _switch(record: RunRecord) -> Iterator[Violation]:
    if record.entries is None:
        yield Violation("switch_unreadable", "the switch did not answer at the end")
        return
    wanted = in_force(record.decisions)
    for address in sorted(wanted - record.entries - record.forgotten):
        yield Violation("decision_without_entry", f"{address} is to be dropped, and is not")
    for address in sorted(record.entries - wanted - record.forgotten):
        yield Violation("entry_without_decision", f"{address} is dropped, and no decision says so")


def _verdicts(record: RunRecord) -> Iterator[Violation]:
    told: set[str] = set()
    for each in record.passed:
        since = record.installed.get(each.address)
        if each.address in record.forgotten:
            continue
        if since is None or each.at <= since or each.at >= record.lifted.get(each.address, float("inf")):
            continue
        if any(fault <= each.at <= fault + RESTORED_S for fault in record.switch_faults):
            continue
        if each.address not in told:
            told.add(each.address)
            yield Violation(
                "passed_while_blocked", f"a frame of {each.address}, {each.at - since:.1f} s late"
            )


def _actives(who: str, words: Sequence[Word], longest_s: float) -> Iterator[Violation]:
    turns: list[tuple[str, float, float]] = []
    for word in sorted(words, key=lambda each: each.at):
        if turns and turns[-1][0] == word.speaker:
            turns[-1] = (word.speaker, turns[-1][1], word.at)
        else:
            turns.append((word.speaker, word.at, word.at))
    spoiled = float("-inf")
    for (before, _, ended), (other, began, left), (after, again, _) in zip(
        turns, turns[1:], turns[2:], strict=False
    ):
        if before == after and again - ended < longest_s:
            # one overlap is one violation, however often the two took turns in it
            if began - spoiled > longest_s:
                turn = f"{other} from {began:.2f} to {left:.2f} s"
                yield Violation(
                    "two_actives", f"{who}: {turn}, amid words of {before} at {ended:.2f} and {again:.2f} s"
                )
            spoiled = began


def gap_ms(sent: Sequence[float], missed: Sequence[int]) -> list[tuple[float, float]]:
    """Runs of missed frames as (when the first was sent, length in ms), in order.

    Args:
        sent: when each frame was sent, s, by number.
        missed: numbers that did not come, or too late, ascending.
    """
    runs: list[tuple[int, int]] = []
    for number in missed:
        if runs and runs[-1][1] == number - 1:
            runs[-1] = (runs[-1][0], number)
        else:
            runs.append((number, number))
    interval = min((after - before for before, after in pairwise(sent[:1000])), default=0.0)
    return [
        (
            sent[first],
            1000 * ((sent[last + 1] if last + 1 < len(sent) else sent[last] + interval) - sent[first]),
        )
        for first, last in runs
    ]


def longest_gaps(
    gaps: Sequence[tuple[float, float]], began: float, most: int = 100
) -> list[dict[str, float]]:
    """The longest gaps, in order of time, so that they can be held against logs.

    Args:
        gaps: as `gap_ms` returns them.
        began: when the first fault was due, on the same clock, s.
        most: how many are kept.
    """
    kept = sorted(sorted(gaps, key=lambda gap: gap[1])[-most:])
    return [{"time": round(at - began, 2), "ms": round(length, 1)} for at, length in kept]
