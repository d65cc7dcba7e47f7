"""Findings 1 to 12: what is claimed, by which criterion it counts as reproduced, and how it is judged.

The criteria stand here before anything is measured; a finding that comes out differently is as good a result.  A figure
that is missing is a finding that was not measured, and says why.
"""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any, Final, Literal

import msgspec

Verdict = Literal["yes", "no", "in part", "not measured"]


class PaperCriterion(msgspec.Struct, frozen=True):
    """A figure and the bar that it is held against."""

    figure: str
    at_most: bool
    bar: float

    def holds(self, value: float) -> bool:
        """Whether a value passes."""
        return value <= self.bar if self.at_most else value >= self.bar


class PaperClaim(msgspec.Struct, frozen=True):
    """What the paper claims, in our words."""

    number: int
    says: str
    paper: str
    """The paper's figure, as far as the claim has one."""
    criteria: tuple[PaperCriterion, ...]


class Measured(msgspec.Struct, frozen=True):
    """One figure over its rounds."""

    values: tuple[float, ...]

    @property
    def median(self) -> float:
        """Median of the rounds."""
        return median(self.values)

    def to_value(self) -> dict[str, Any]:
        """Median, spread and all rounds."""
        return {
            "median": self.median,
            "least": min(self.values),
            "most": max(self.values),
            "rounds": list(self.values),
        }


class JudgedFinding(msgspec.Struct, frozen=True, kw_only=True):
    """A finding and how it came out."""

    number: int
    says: str
    paper: str
    reproduced: Verdict
    sentence: str
    figures: Mapping[str, Mapping[str, Any]]
    criteria: Sequence[PaperCriterion]


def _most(figure: str, bar: float) -> PaperCriterion:
    return PaperCriterion(figure, at_most=True, bar=bar)


def _least(figure: str, bar: float) -> PaperCriterion:
    return PaperCriterion(figure, at_most=False, bar=bar)


CLAIMS: Final = (
    PaperClaim(
        1, "A message of 1 KB arrives sooner than an event of the controller framework Ryu.", "below Ryu's",
        (_most("latency_to_osken", 1.0),),
    ),
    PaperClaim(
        2, "Latency is at most a tenth above raw Redis, one by one and in batches of 100.", "at most 10 % more",
        (_most("latency_to_raw_batch1", 1.1), _most("latency_to_raw_batch100", 1.1)),
    ),
    PaperClaim(3, "Batching multiplies throughput.", "5 times", (_least("batch100_to_batch1", 5.0),)),
    PaperClaim(4, "One core carries over 100,000 messages a second.", "over 100,000/s", (_least("per_second", 1e5),)),
    PaperClaim(
        5, "Archiving everything hardly slows the publisher, unthrottled.", "hardly",
        (_least("sqlite_on_to_off", 0.9), _least("mongodb_on_to_off", 0.9)),
    ),
    PaperClaim(
        6, "Batches make the archive faster: 1,000 against 1.", "much faster",
        (_least("sqlite_batch1000_to_1", 5.0), _least("mongodb_batch1000_to_1", 5.0)),
    ),
    PaperClaim(
        7, "In a star of 60 apps the sum falls by no more than a third at 100 ms.", "a third less",
        (_least("sum_100ms_to_0ms", 0.67),),
    ),
    PaperClaim(
        8, "The sum does not fall as pairs are added.", "grows up to the hub's capacity",
        (_least("sum_at_most_pairs_to_best", 0.9),),
    ),
    PaperClaim(9, "Apps share fairly (Jain's index).", "fair", (_least("jain", 0.95),)),
    PaperClaim(
        10, "Central scheduling on digital twins shortens production.", "shorter",
        (_most("makespan_to_decentralized", 0.7), _most("makespan_to_bound", 1.1)),
    ),
    PaperClaim(
        11, "It stays the best when printers fail, at every fleet size.", "best",
        (_most("anomalies_to_best_other", 1.0),),
    ),
    PaperClaim(
        12, "Urgent orders are done 50 to 100 % faster, and the rest not later.", "50 to 100 % faster",
        (_most("urgent_to_best_other", 0.67), _most("final_to_best_other", 1.02)),
    ),
)  # fmt: skip
"""Of findings 11 and 12 the figure is the worst of all fleet sizes."""

WHY: Final = {
    1: "os-ken, Ryu's successor, hands an event over inside one process; DUE goes through a server to another one.",
    5: "a publisher alone makes more messages a second than the archive takes (`archive_alone_to_off`); once the "
    "archive's queue is full, `write` waits, and nothing is lost. `burst_on_to_off` is before that.",
    12: "the paper's other schedulers ignore priority; `urgent_first` beside it does not.",
}
"""What is known of the reason, where a figure needs one."""


def judge(claim: PaperClaim, figures: Mapping[str, Measured], missing: str = "") -> JudgedFinding:
    """Hold the figures against the criteria; without a figure of a criterion it was not measured, with `missing`."""
    here = [one for one in claim.criteria if one.figure in figures]
    held = [one.holds(figures[one.figure].median) for one in here]
    verdict: Verdict
    if len(here) < len(claim.criteria):
        verdict, sentence = "not measured", missing or "no figure"
    else:
        verdict = "yes" if all(held) else "in part" if any(held) else "no"
        sentence = "; ".join(
            f"{one.figure} is {figures[one.figure].median:.3g}, {'at most' if one.at_most else 'at least'} "
            f"{one.bar:g} was wanted"
            for one in here
        )
        if claim.number in WHY:
            sentence += f": {WHY[claim.number]}"
    return JudgedFinding(
        number=claim.number,
        says=claim.says,
        paper=claim.paper,
        reproduced=verdict,
        sentence=sentence,
        figures={name: one.to_value() for name, one in figures.items()},
        criteria=claim.criteria,
    )
