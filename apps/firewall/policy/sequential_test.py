"""When evidence suffices: a sequential test for each sender and each victim.  Pure.

Nats of evidence add up and fade; a decision is due when the sum crosses a bound.  The bound follows from a
budget of false blocks: training, which lasted T and saw m senders, showed nothing above its own highest counts,
so about m of them are to be expected in another T; a sum of A nats is exp(A) times rarer than that.  With a
budget of b false blocks a day

    A = ln(m · day / (T · b))

Sources that saw the same packets say the same thing twice, so the largest counts in full and the others by a
quarter.  Evidence that only supports other evidence makes up a part of the bound at most; so does forgeable evidence
that names an address only, in the sum of the sender last seen with it: another may have sent that under its address.

Source: Wald, Sequential Analysis, 1947; the fading sum is that of a CUSUM (Page, 1954) with a half-life in place
of a drift.
"""

import math
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Final

from msgspec import structs

from apps.evidence import Evidence, TrainingState
from apps.firewall.evidence.shared import shared_text
from apps.messages import Sender

DAY_S: Final = 86_400.0
HALF_LIFE_S: Final = 600.0
"""Seconds of capture time after which half of the evidence is forgotten."""
DEPENDENT_SHARE: Final = 0.25
"""Part of its nats with which evidence counts beside stronger evidence from the same packets."""
SUPPORTING_SHARE: Final = 0.3
"""Part of the bound that supporting evidence can make up."""
MOST_EXTRAPOLATION: Final = 1e6
"""Training that would have to be multiplied by more than this to reach the budget decides no blocks."""
LEAST_BOUND: Final = 5.0
MOST_SUBJECTS: Final = 16_384
MOST_SOURCES: Final = 32
"""Sources remembered for one subject."""
FADED_NATS: Final = 0.1
"""A sum that has faded to less decides nothing any more, and is forgotten."""
FADED_SUPPORT_NATS: Final = 0.5
"""The same of a sum of supporting evidence alone, which decides nothing by itself."""
PLACE_HELD_S: Final = 3_600
"""Seconds of capture time for which it is known where an address was last seen."""
_SWEEP_S: Final = 60
_SECOND: Final = 1_000_000_000

_BY_ADDRESS: Final = " by address"
"""Suffix of a source where it names no sender: its weight is not that of what it says about a sender."""

UNPLACED: Final = "unplaced"
"""In place of a service: the address of a sender whose port and MAC are unknown."""

Subject = Sender | tuple[str, str]
"""A sender; or a victim's address and service."""


@dataclass(slots=True)
class SourceNats:
    """The nats of one source, as of its last evidence."""

    nats: float
    time: int
    latest: Evidence

    def at(self, now: int) -> float:
        """Its nats at a capture time, ns."""
        return self.nats * math.exp2(-max(0, now - self.time) / _SECOND / HALF_LIFE_S)


@dataclass(slots=True)
class EvidenceSum:
    """All evidence about one subject."""

    subject: Subject
    contributions: dict[str, SourceNats] = field(default_factory=dict)

    def total(self, now: int, bound: float) -> float:
        """The sum in nats at a capture time, ns."""
        return sum(nats for nats, _ in self.shares(now, bound))

    def faded(self, now: int, bound: float) -> bool:
        """Whether nothing is left that could count in a decision."""
        alone = any(not each.latest.supporting for each in self.contributions.values())
        return self.total(now, bound) < (FADED_NATS if alone else FADED_SUPPORT_NATS)

    def shares(self, now: int, bound: float) -> list[tuple[float, SourceNats]]:
        """What each source adds to the sum, the largest first."""
        weights = [(each.at(now), each) for each in self.contributions.values()]
        alone = sorted((pair for pair in weights if not pair[1].latest.supporting), key=lambda pair: -pair[0])
        shares = [
            (nats if not place else DEPENDENT_SHARE * nats, each) for place, (nats, each) in enumerate(alone)
        ]
        left = SUPPORTING_SHARE * bound
        for nats, each in weights:
            if each.latest.supporting:
                shares.append((min(nats, left), each))
                left -= min(nats, left)
        return sorted(shares, key=lambda pair: -pair[0])


class SequentialTest:
    """Sums of evidence, and the bound that they have to cross.

    Args:
        false_blocks_per_day: budget, greater than 0.
    """

    def __init__(self, false_blocks_per_day: float) -> None:
        self._budget = false_blocks_per_day
        self._tallies: OrderedDict[Subject, EvidenceSum] = OrderedDict()
        self._placed: OrderedDict[str, tuple[Sender, int]] = OrderedDict()
        """By address: the sender last seen with it, and when; the one seen last is the last."""
        self._swept = 0
        self.training: TrainingState | None = None
        """The training that evidence rests on; None: none is done."""

    def __len__(self) -> int:
        return len(self._tallies)

    @property
    def extrapolation(self) -> float:
        """How often training would have to be repeated for one false block of the budget."""
        training = self.training
        if training is None or not training.done:
            return math.inf
        return max(1, training.senders) * DAY_S / (max(1.0, training.seconds) * self._budget)

    @property
    def bound(self) -> float:
        """Nats that a sum has to reach."""
        return max(LEAST_BOUND, math.log(min(self.extrapolation, MOST_EXTRAPOLATION)))

    @property
    def too_short(self) -> bool:
        """Whether training cannot bear out the budget, so that nobody may be blocked."""
        return self.extrapolation > MOST_EXTRAPOLATION

    def hear(self, evidence: Evidence, app: str) -> EvidenceSum:
        """Add evidence that an app wrote; returns all that there is about its subject."""
        self._sweep(evidence.event_time)
        if evidence.sender is not None and evidence.sender.ip:
            self._place(evidence.sender, evidence.event_time)
        subject, source = self._subject_of(evidence), shared_text(f"{app}.{evidence.source}")
        if evidence.sender is None and evidence.forgeable and isinstance(subject, Sender):
            evidence, source = structs.replace(evidence, supporting=True), shared_text(source + _BY_ADDRESS)
        now = evidence.event_time
        tally = self._tallies.get(subject)
        if tally is None:
            if len(self._tallies) >= MOST_SUBJECTS:
                self._tallies.popitem(last=False)
            tally = self._tallies[subject] = EvidenceSum(subject)
        self._tallies.move_to_end(subject)
        former = tally.contributions.get(source)
        nats = evidence.nats
        if former is not None:
            nats += former.at(now)
            now = max(now, former.time)
        elif len(tally.contributions) >= MOST_SOURCES:
            weakest = min(tally.contributions, key=lambda each: tally.contributions[each].at(now))
            del tally.contributions[weakest]
        tally.contributions[source] = SourceNats(nats, now, _kept(evidence, former))
        return tally

    def sum_of(self, evidence: Evidence) -> float:
        """The sum for the subject of a piece of evidence, at its time."""
        tally = self._tallies.get(self._subject_of(evidence))
        return 0.0 if tally is None else tally.total(evidence.event_time, self.bound)

    def placed(self, evidence: Evidence) -> Evidence:
        """Evidence about a plain address with the sender that was last seen with it, if there is one."""
        sender = self._last_with(evidence.address) if evidence.sender is None else None
        return evidence if sender is None else structs.replace(evidence, sender=sender, address="")

    def _last_with(self, address: str) -> Sender | None:
        return self._placed.get(address, (None, 0))[0]

    def _place(self, sender: Sender, now: int) -> None:
        self._placed[sender.ip] = sender, now
        self._placed.move_to_end(sender.ip)
        if len(self._placed) > MOST_SUBJECTS:
            self._placed.popitem(last=False)

    def _sweep(self, now: int) -> None:
        """Once a minute, forget what can have no part in a decision: a network meets ever new addresses."""
        # a clock that was ahead may have been set back since; evidence that is merely late is no sign of that
        if -PLACE_HELD_S * _SECOND < now - self._swept < _SWEEP_S * _SECOND:
            return
        if now < self._swept:  # what was noted while the clock was ahead would not fade until then
            for tally in self._tallies.values():
                for each in tally.contributions.values():
                    each.time = min(each.time, now)
        self._swept = now
        bound = self.bound
        for subject in [each for each, tally in self._tallies.items() if tally.faded(now, bound)]:
            del self._tallies[subject]
        while self._placed and abs(now - next(iter(self._placed.values()))[1]) > PLACE_HELD_S * _SECOND:
            self._placed.popitem(last=False)

    def _subject_of(self, evidence: Evidence) -> Subject:
        """Whom evidence is about; a plain address is that of a sender who has been seen, if there is one."""
        if evidence.sender is not None:
            return evidence.sender
        if evidence.address:
            return self._last_with(evidence.address) or (evidence.address, UNPLACED)
        return evidence.victims[0], evidence.service

    def forget(self, subject: Subject) -> None:
        """Reset the sum of a subject: after a decision, or a false alarm."""
        self._tallies.pop(subject, None)


def _kept(evidence: Evidence, former: SourceNats | None) -> Evidence:
    """What is kept of a piece for an hour: names that others have, too, and the words of one that added something."""
    before = former.latest.text if former is not None else ""
    return structs.replace(
        evidence,
        id="",
        service=shared_text(evidence.service),
        victims=tuple(map(shared_text, evidence.victims)),
        text=evidence.text if evidence.nats > 0 else before,
    )
