"""What is decided, how soon, and how often wrongly: `python -m benchmarks.decisions --json FILE`.

Detector and decisions alone (`benchmarks.decisions_core`) on generated networks (`benchmarks.decision_traffic`):
an hour of training, an hour of benign traffic, and in it, each in a process of its own that begins from the
trained state, every attack and every kind of benign novelty; then days of benign traffic.  The same for the rule
of the paper (block at the first score over the threshold) and the rule of seconds (five anomalous seconds of ten).

    attacks, mitigated        how many, and how many had an effective decision (block, guard) within 5 s
    median_s_to_decision      capture seconds from the attack's first packet; an attack without any counts as endless
    stopped_share_median      share of the attack's packets that were dropped or challenged
    innocent_blocks           blocks during attacks of somebody who is not the attacker
    novelty_blocks            blocks in benign novelty
    false_blocks_per_day, …_upper95   blocks a day of benign traffic, and the upper end of its 95 % interval
    by_attack, paper_rule, seconds_rule

Attacks whose number is over 100 are held back: `--held-back` runs those instead.  Not part of it: switch, meters,
queries as evidence, FastNetMon.
"""

import ipaddress
import json
import math
import os
import pickle
import statistics
import sys
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

from scipy.stats import chi2

from apps.firewall.policy.rules import Rules
from benchmarks import measure
from benchmarks.decision_traffic.attacks import ATTACKS
from benchmarks.decision_traffic.network import Network
from benchmarks.decision_traffic.networks import NETWORKS
from benchmarks.decision_traffic.novelty import NOVELTIES
from benchmarks.decision_traffic.traffic import BASE_US, Traffic, merge, renumbered
from benchmarks.decision_traffic.truth import AttackSpec, AttackTruth
from benchmarks.decisions_core import DecidedAction, DecisionRun

RULES: Final = {"sequential": "", "paper": "paper_rule", "seconds": "seconds_rule"}
"""Rule of the firewall to the field of its figures; the default's stand at the top."""
TRAINING_S: Final = 3_600.0
BENIGN_S: Final = 5_400.0
"""Benign traffic before an attack begins, training included."""
ATTACK_S: Final = BENIGN_S + 60
LONGEST_S: Final = 120.0
"""Of an attack that is looked at."""
NOVELTY_S: Final = 900.0
SOON_S: Final = 5.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run networks, rules, attacks, novelty and days; print a table, write the figures."""
    parser = measure.arguments("decisions", __doc__, rounds=1)
    parser.add_argument("--networks", nargs="+", choices=[*NETWORKS], default=[*NETWORKS])
    parser.add_argument("--rules", nargs="+", choices=[*RULES], default=[*RULES])
    parser.add_argument("--seeds", type=int, default=3, help="seeds of each attack and novelty")
    parser.add_argument(
        "--days", type=int, default=6, help="days of benign traffic, one for each network and seed"
    )
    parser.add_argument("--held-back", action="store_true", help="the attacks that nobody tunes on")
    chosen = parser.parse_args(argv)
    figures: dict[str, Any] = {
        "machine": measure.machine(),
        "settings": vars(chosen) | {"json": str(chosen.json)},
    }
    for rule, field in RULES.items():
        if rule in chosen.rules:
            found = _rule(rule, chosen)
            figures |= {field: found} if field else found
            print(
                json.dumps(
                    {"rule": rule} | {key: value for key, value in found.items() if key != "by_attack"}
                )
            )
            sys.stdout.flush()
            if chosen.json:
                chosen.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    return 0


def _rule(rule: str, chosen: Any) -> dict[str, Any]:
    rows: list[dict[str, Any]] = []
    novelty: list[dict[str, Any]] = []
    for name in chosen.networks:
        found = _network(rule, name, chosen)
        rows += found["attacks"]
        novelty += found["novelty"]
    days = _days(rule, chosen)
    blocks = sum(day["blocks"] for day in days)
    seconds = [row["s_to_decision"] for row in rows]
    measure.table(
        ("network", "attack", "seed", "s to decision", "stopped", "wrong"),
        [
            (
                row["network"],
                row["attack"],
                row["seed"],
                row["s_to_decision"],
                row["stopped_share"],
                row["wrong"],
            )
            for row in rows
        ],
    )
    return {
        "attacks": len(rows),
        "mitigated": sum(row["s_to_decision"] <= SOON_S for row in rows),
        "median_s_to_decision": statistics.median(seconds) if seconds else None,
        "stopped_share_median": statistics.median(row["stopped_share"] for row in rows) if rows else None,
        "innocent_blocks": sum(row["wrong"] for row in rows),
        "novelty_runs": len(novelty),
        "novelty_blocks": sum(row["blocks"] for row in novelty),
        "benign_days": len(days),
        "false_blocks_per_day": blocks / len(days) if days else None,
        "false_blocks_per_day_upper95": float(chi2.ppf(0.95, 2 * (blocks + 1))) / 2 / len(days)
        if days
        else None,
        "by_attack": rows,
        "by_novelty": novelty,
        "by_day": days,
    }


def _network(rule: str, name: str, chosen: Any) -> dict[str, list[dict[str, Any]]]:
    """Train once, and run every attack and novelty from there in a process of its own."""
    network = NETWORKS[name](1)
    benign = merge(*network.chunks(0, BENIGN_S + NOVELTY_S + 60))
    run = _trained(rule, benign)
    specs = [each for each in ATTACKS if each.held_back == chosen.held_back and each.fits(network)]
    specs = specs[: max(1, round(len(specs) * chosen.scale))]
    novelties = list(NOVELTIES)[: max(1, round(len(NOVELTIES) * chosen.scale))]
    return {
        "attacks": [
            {"network": name, "attack": spec.name, "number": spec.number, "seed": seed}
            | _apart(partial(_attack, run, network, benign, spec, seed))
            for spec in specs
            for seed in range(1, chosen.seeds + 1)
        ],
        "novelty": [
            {"network": name, "novelty": which, "seed": seed}
            | _apart(partial(_novelty, run, network, benign, which, seed))
            for which in novelties
            for seed in range(1, chosen.seeds + 1)
        ],
    }


def _trained(rule: str, benign: Traffic) -> DecisionRun:
    packets = len(benign.between(0, TRAINING_S))
    run = DecisionRun(packets, Rules(rule=rule))  # type: ignore[arg-type]
    run.feed(benign.between(0, BENIGN_S))
    run.decided.clear()
    run.refused.clear()
    return run


def _apart(work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Do it in a copy of this process, which alone can copy the detector's state."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        code = 1
        try:
            with os.fdopen(writer, "wb") as pipe:
                pickle.dump(work(), pipe)
            code = 0
        except BaseException:  # noqa: BLE001 - the copy must not go on as if it were this process
            traceback.print_exc()
        os._exit(code)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        data = pipe.read()
    if os.waitpid(child, 0)[1]:
        raise SystemExit("benchmarks.decisions: a run failed, see above")
    found: dict[str, Any] = pickle.loads(data)  # noqa: S301 - our own child's
    return found


def _attack(
    run: DecisionRun, network: Network, benign: Traffic, spec: AttackSpec, seed: int
) -> dict[str, Any]:
    sent, truth = spec.traffic(network, seed, ATTACK_S)
    end = min(truth.last_us / 1e6 - BASE_US / 1e6, ATTACK_S + LONGEST_S) + 1
    traffic = renumbered(
        merge(benign.between(BENIGN_S, end), sent.between(BENIGN_S, end)), len(benign.between(0, BENIGN_S))
    )
    stopped = run.feed(traffic)
    mine = traffic.attack == truth.id
    first_ns = truth.first_us * 1_000
    good = [each for each in run.decided if _helps(each, truth)]
    wrong = [each for each in run.decided if not _helps(each, truth)]
    return {
        "s_to_decision": min(((each.time_ns - first_ns) / 1e9 for each in good), default=math.inf),
        "packets": int(mine.sum()),
        "stopped_share": float(stopped[mine].mean()) if mine.any() else 0.0,
        "innocent_packets": int(stopped[~mine].sum()),
        "wrong": len(wrong),
        "decisions": [each.reason for each in (*good[:2], *wrong[:3])],
        "refused": run.refused[:2],
    }


def _helps(decided: DecidedAction, truth: AttackTruth) -> bool:
    """Whether a decision stops the attacker, and nobody else."""
    if decided.service is not None:
        victims = {str(ipaddress.IPv4Address(victim)) for victim in truth.victims}
        return "guard" in truth.remedies and decided.service.address in victims
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


def _novelty(run: DecisionRun, network: Network, benign: Traffic, name: str, seed: int) -> dict[str, Any]:
    sent = NOVELTIES[name](network, seed, ATTACK_S)
    end = ATTACK_S + NOVELTY_S
    before = len(benign.between(0, BENIGN_S))
    run.feed(renumbered(merge(benign.between(BENIGN_S, end), sent.between(BENIGN_S, end)), before))
    return {"blocks": len(run.decided), "decisions": [each.reason for each in run.decided[:3]]}


def _days(rule: str, chosen: Any) -> list[dict[str, Any]]:
    """Days of benign traffic after an hour of training: each of another network or seed."""
    found = []
    for number in range(chosen.days):
        name = chosen.networks[number % len(chosen.networks)]
        seed = 11 + number // len(chosen.networks)
        found.append({"network": name, "seed": seed} | _apart(partial(_day, rule, name, seed)))
    return found


def _day(rule: str, name: str, seed: int) -> dict[str, Any]:
    network = NETWORKS[name](seed)
    packets = sum(len(part) for part in network.chunks(0, TRAINING_S))
    run = DecisionRun(packets, Rules(rule=rule))  # type: ignore[arg-type]
    for part in network.chunks(0, TRAINING_S + 86_400):
        run.feed(part)
    return {
        "blocks": len(run.decided),
        "packets": run.detector.model.trained,
        "dropped": run.dropped,
        "decisions": [each.reason for each in run.decided[:5]],
        "refused": len(run.refused),
        "bound": run.decider.test.bound,
    }


if __name__ == "__main__":
    sys.exit(main())
