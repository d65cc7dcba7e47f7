"""What a run has done about an attack: a row of the figures of `benchmarks.decisions`."""

import ipaddress
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.decision_reach import SOON_S, needed, shown_soon
from benchmarks.decision_traffic.network import Network
from benchmarks.decision_traffic.traffic import SECOND, Traffic
from benchmarks.decision_traffic.truth import AttackTruth
from benchmarks.decisions_core import DecidedAction, DecisionRun, EvidenceHeard


def row_of(
    run: DecisionRun, traffic: Traffic, truth: AttackTruth, network: Network, training_s: float
) -> dict[str, Any]:
    """What a run has done about an attack.

    Args:
        run: fed with the traffic.
        traffic: the attack's packets and others.
        truth: about the attack.
        network: where it happens.
        training_s: length of training, s.
    """
    stopped, mine = run.stopped, traffic.attack == truth.id
    first_ns, soon = truth.first_us * 1_000, truth.first_us + round(SOON_S * SECOND)
    shown, what = shown_soon(traffic, truth)
    good = [each for each in run.decided if _helps(each, truth)]
    wrong = [each for each in run.decided if not _helps(each, truth)]
    others = stopped & ~mine & ~_sent_by(traffic, truth, network.gateway.mac)
    hit = [traffic.columns[name][others & ~run.limited].tolist() for name in ("port", "eth_src", "ip_src_lo")]
    return {
        "attack": truth.name,
        "s_to_decision": min(((each.time_ns - first_ns) / 1e9 for each in good), default=math.inf),
        "packets": int(mine.sum()),
        "shown_soon": shown,
        "shown": what,
        "shown_needed": needed(truth, training_s, run.rules),
        "nats_soon": max(
            (each.nats for each in run.heard if each.time_ns <= soon * 1_000 and _is_about(each, truth)),
            default=0.0,
        ),
        "bound": run.decider.test.bound,
        "peak_score": float(run.scores[mine].max(initial=0.0)),
        "over_1": int((run.scores[mine] >= 1).sum()),
        "stopped_share": float(stopped[mine].mean()) if mine.any() else 0.0,
        "dropped": int((stopped & ~run.challenges & ~run.limited)[mine].sum()),
        "challenged": int(run.challenges[mine].sum()),
        "limited": int(run.limited[mine].sum()),
        "innocent_packets": int((others & ~run.limited).sum()),
        "innocent_limited": int((others & run.limited).sum()),
        "innocent_hosts": len(set(zip(*hit, strict=True))),
        "remedy": _remedy(good[0]) if good else "none",
        "wrong": len(wrong),
        "decisions": [each.reason for each in (*good[:2], *wrong[:3])],
        "refused": run.refused[:2],
    }


def _is_about(heard: EvidenceHeard, truth: AttackTruth) -> bool:
    """Whether evidence is about an attacker, or for a victim where it names no sender."""
    sender = heard.sender
    if sender is None:
        return bool(heard.victims) and int(ipaddress.ip_address(heard.victims[0])) in truth.victims
    return any(
        (sender.port, int(sender.mac.replace(":", ""), 16)) == (attacker.port, attacker.mac)
        and (not attacker.ip or not sender.ip or int(ipaddress.ip_address(sender.ip)) == attacker.ip)
        for attacker in truth.attackers
    )


def _sent_by(traffic: Traffic, truth: AttackTruth, router: int) -> npt.NDArray[np.bool_]:
    """Which packets attackers have sent under their own address, as part of the attack or not."""
    found = np.zeros(len(traffic), bool)
    columns = traffic.columns
    for attacker in truth.attackers:
        if attacker.ip:
            mine = (columns["port"] == attacker.port) & (columns["eth_src"] == attacker.mac)
            found |= mine if attacker.mac != router else mine & (columns["ip_src_lo"] == attacker.ip)
    return found


def _helps(decided: DecidedAction, truth: AttackTruth) -> bool:
    """Whether a decision stops the attacker, and nobody else."""
    if decided.service is not None:
        victims = {str(ipaddress.IPv4Address(victim)) for victim in truth.victims}
        return "guard" in truth.remedies and decided.service.address in victims
    if decided.limited:
        victims = {str(ipaddress.IPv4Address(victim)) for victim in truth.victims}
        return "meter" in truth.remedies and decided.limited in victims
    target = decided.target
    if target is None:
        return False
    for attacker in truth.attackers:
        mac = attacker.mac.to_bytes(6, "big").hex(":")
        if target.kind == "mac" and target.address == mac and target.port in (None, attacker.port):
            return "block_sender" in truth.remedies
        if target.kind == "ip" and attacker.ip and target.address == str(ipaddress.IPv4Address(attacker.ip)):
            return "block_address" in truth.remedies
    return False


def _remedy(decided: DecidedAction) -> str:
    """What was decided, in a word or two."""
    if decided.service is not None:
        return "guard"
    if decided.limited:
        return "rate limit"
    return (
        "block of an address"
        if decided.target is not None and decided.target.kind == "ip"
        else "block of a MAC"
    )
