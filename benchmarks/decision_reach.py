"""Which attacks nobody can decide about in time, and why the others were missed.

What no host of training did weighs ln(m) nats, if training saw m senders, plus what exceeds their highest count.  The
bound is ln(m · day / (T · b)) after a training of T with a budget of b false blocks a day.  So even if nobody ever
failed to reach anybody, or ever logged in, the attack itself has to show

    ln(day / (T · b))

nats: 5.5 after an hour with the default budget.  A packet weighs one at most, a login a little more.  Not so a claim
of somebody else's address, a SYN that no stack sends, nor scores: attacks that show less within five seconds and were
mitigated all the same count as within reach.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from apps.firewall.policy.rules import Rules
from apps.firewall.policy.sequential_test import DAY_S
from benchmarks.decision_traffic.packets import ACK, SYN
from benchmarks.decision_traffic.traffic import SECOND, Traffic
from benchmarks.decision_traffic.truth import AttackTruth

SOON_S: Final = 5.0
"""Seconds of capture time within which an attack is mitigated."""
LOGIN_NATS: Final = 1 / 0.9
"""What a login weighs at most (the least scale of logins in `apps.kitsune.behaviour`)."""


def shown_soon(traffic: Traffic, truth: AttackTruth) -> tuple[int, str]:
    """What an attack shows in time: how many packets, or of guessing how many logins; and which of the two."""
    soon = traffic.columns["time_us"] <= truth.first_us + SOON_S * SECOND
    mine = soon & (traffic.attack == truth.id)
    if truth.kind != "guessing":
        return int(mine.sum()), "packets"
    return int((mine & (traffic.columns["tcp_flags"] & (SYN | ACK) == SYN)).sum()), "logins"


def needed(truth: AttackTruth, training_s: float, rules: Rules) -> int:
    """How many of them it needs, so that evidence can reach the bound.

    Args:
        truth: about the attack.
        training_s: length of training, s.
        rules: for the budget of false blocks.
    """
    if truth.kind == "spoofing":
        return 1
    nats = math.log(DAY_S / (training_s * rules.false_blocks_per_day))
    return max(1, math.ceil(nats / LOGIN_NATS if truth.kind == "guessing" else nats))


def unreachable(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Attacks out of reach that were not mitigated, each with the reason."""
    return [
        _of(row)
        | {
            "reason": f"{_counted(row['shown_soon'], row['shown'])} within {SOON_S:g} s:"
            f" with fewer than {row['shown_needed']} evidence cannot reach the bound"
        }
        for row in rows
        if row["s_to_decision"] > SOON_S and row["shown_soon"] < row["shown_needed"]
    ]


def missed(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Attacks within reach that were not mitigated, each with the reason."""
    return [
        _of(row) | {"reason": _reason(row)}
        for row in rows
        if row["s_to_decision"] > SOON_S and row["shown_soon"] >= row["shown_needed"]
    ]


def _counted(number: int, nouns: str) -> str:
    return f"{number} {nouns.removesuffix('s') if number == 1 else nouns}"


def _of(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: row[name] for name in ("network", "attack", "seed")}


def _reason(row: Mapping[str, Any]) -> str:
    """Refused, wrong or late."""
    late = row["s_to_decision"]
    when = "never decided" if math.isinf(late) else f"decided after {late:.1f} s"
    if row["refused"]:
        return f"{when}; refused: {row['refused'][0]}"
    if row["nats_soon"] and row["nats_soon"] < row["bound"]:
        return f"{when}; {row['nats_soon']:.1f} nats within {SOON_S:g} s, {row['bound']:.1f} needed"
    return when
