"""The figures of a replay, from the state of each packet.  Pure."""

import ipaddress
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from apps.messages import Confirmation, Decision
from sdnator.capture.labels import Labels
from sdnator.replay.packet_accounting import PacketAccounting, PacketState
from sdnator.replay.passed_in_flight import InFlight
from sdnator.replay.survey import Survey


def roc_auc(attack: NDArray[np.bool_], score: NDArray[np.float64]) -> float | None:
    """Area under the ROC curve (Mann-Whitney, ties count half); None if one class is missing."""
    positives = int(np.count_nonzero(attack))
    negatives = len(attack) - positives
    if not positives or not negatives:
        return None
    ranks = rankdata(score)
    return float((ranks[attack].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def auc(flight: PacketAccounting, labels: Labels) -> float | None:
    """ROC AUC over the scored packets after training."""
    scored = flight.state == PacketState.SCORED
    return roc_auc(labels.attack[scored], flight.score[scored])


def from_attackers(survey: Survey, labels: Labels) -> NDArray[np.bool_]:
    """True for packets, malicious or not, that an attacker of the labels sent.

    If the labels name no attackers, the MAC addresses that sent attack packets count as attackers.
    """
    names = labels.attackers
    if not names:
        return np.isin(survey.eth_src, np.unique(survey.eth_src[labels.attack]))
    macs = [int(name.replace(":", ""), 16) for name in names if name.count(":") == 5 and len(name) == 17]
    addresses = [int(ipaddress.IPv4Address(name)) for name in names if name.count(".") == 3]
    found: NDArray[np.bool_] = np.isin(survey.eth_src, np.array(macs, np.uint64))
    return found | np.isin(survey.ipv4_src, np.array(addresses, np.uint32))


def block_rows(
    survey: Survey,
    decisions: Sequence[Decision],
    confirmations: Sequence[Confirmation],
    first_arrival: int = 0,
    in_flight: InFlight | None = None,
) -> list[dict[str, Any]]:
    """One row for each block that the switch installed, in the order of installing.

    `time` is the capture time of the packet before which the block was in force, not that of the
    decision: the packets that were in flight between them count as time to block.
    """
    by_id = {decision.id: decision for decision in reversed(decisions) if decision.action == "block"}
    rows = []
    for confirmation in confirmations:
        decision = by_id.get(confirmation.id)
        if decision is None or confirmation.state != "installed":
            continue
        packet = max(0, confirmation.arrival - first_arrival)
        rows.append(
            {
                "id": decision.id,
                "address": decision.target.address,
                "reason": decision.reason,
                "time": int(survey.time_ns[min(packet, survey.packets - 1)]) / 1e9,
                "decided": decision.event_time / 1e9,
                "packet": packet,
                "handle": confirmation.handle,
                **_in_flight_of(decision.id, in_flight),
            }
        )
    return rows


def _in_flight_of(decision_id: str, in_flight: InFlight | None) -> dict[str, int]:
    if in_flight is None:
        return {}
    return {
        "in_flight": in_flight.of_all[decision_id],
        "passed_in_flight": in_flight.of_sender[decision_id],
    }


def attack_figures(
    survey: Survey,
    labels: Labels,
    flight: PacketAccounting,
    first_block: dict[str, Any] | None,
    limited: NDArray[np.bool_] | None = None,
) -> dict[str, Any]:
    """Figures from labels: how much of the attack was stopped, and which benign packets were dropped.

    Packets that a rate limit dropped (`limited`) are a part of `attack_dropped`; benign ones are counted apart.
    """
    sent = np.arange(survey.packets) < flight.sent
    dropped = (flight.state == PacketState.DROPPED) & sent
    over = np.zeros(survey.packets, np.bool_) if limited is None else limited & dropped
    blocked = dropped & ~over
    attackers = from_attackers(survey, labels)
    first_attack = int(np.argmax(labels.attack)) if bool(labels.attack.any()) else None
    capture_seconds = None
    after = 0
    if first_block is not None:
        after = int(np.count_nonzero(labels.attack[first_block["packet"] :]))
        if first_attack is not None:
            capture_seconds = first_block["time"] - int(survey.time_ns[first_attack]) / 1e9
    return {
        "first_attack_packet": first_attack,
        "time_to_block_capture_s": capture_seconds,
        "attack_packets": int(np.count_nonzero(labels.attack)),
        "attack_dropped": int(np.count_nonzero(dropped & labels.attack)),
        "attack_after_first_block": after,
        "benign_dropped": int(np.count_nonzero(blocked & ~labels.attack & ~attackers)),
        "collateral_dropped": int(np.count_nonzero(blocked & ~labels.attack & attackers)),
        "attack_limited": int(np.count_nonzero(over & labels.attack)),
        "benign_limited": int(np.count_nonzero(over & ~labels.attack)),
    }
