"""What is decided, how soon, and how often wrongly: `python -m benchmarks.decisions --json FILE`.

Detector and decisions alone (`benchmarks.decisions_core`) on generated networks (`benchmarks.decision_traffic`):
an hour of training, half an hour of benign traffic, and then, each in a process of its own that begins from the
trained state, every attack and every kind of benign novelty; then days of benign traffic.  The same for the rule
of the paper (block at the first score over the threshold) and the rule of seconds (five anomalous seconds of ten).

    attacks, mitigated        how many, and how many had an effective decision (block, guard) within 5 s
    median_s_to_decision      capture seconds from the attack's first packet; an attack without any counts as endless
    stopped_share_median      share of the attack's packets that were dropped or challenged
    innocent_blocks           blocks during attacks of somebody who is not the attacker, the victim included
    novelty_blocks            blocks in benign novelty
    false_blocks_per_day, …_upper95   blocks a day of benign traffic, and the upper end of its 95 % interval
    captured                  how many captured attacks there are, held back or not; or why none
    real_benign               the benign part of the real capture: packets behind training, blocks
    by_attack                 with the packets dropped and challenged, and the packets and hosts of others that were hit;
                              `peak_score` and `over_1` are Kitsune's scores of the attack's packets, those dropped
                              apart: where none is over 1, the two other rules cannot block
    paper_rule, seconds_rule  the same under these rules
    fastnetmon                Debian's FastNetMon on the floods (seed 1), with its settings, or why it was not run

Attacks are stopped under each rule for itself.  In days, novelty and the real capture all rules judge what one
detector says and nothing is stopped, which is the same where a rule blocks nobody, and spares two thirds of the time.

Attacks whose number is between 101 and 200 are held back: `--held-back` runs those instead, and captured ones that
are.  Not part of it: switch, meters, queries as evidence.
"""

import ipaddress
import json
import math
import os
import pickle
import select
import statistics
import sys
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from apps.firewall.policy.rules import Rules
from benchmarks import measure
from benchmarks.data_folder import add_data_option
from benchmarks.decision_traffic.attacks import ATTACKS
from benchmarks.decision_traffic.network import Network
from benchmarks.decision_traffic.networks import NETWORKS
from benchmarks.decision_traffic.novelty import NOVELTIES
from benchmarks.decision_traffic.real import real_attacks, real_network
from benchmarks.decision_traffic.traffic import BASE_US, SECOND, Traffic, merge, renumbered
from benchmarks.decision_traffic.truth import AttackSpec, AttackTruth
from benchmarks.decisions_core import DecidedAction, DecisionRun, detector_for, watch
from benchmarks.decisions_fastnetmon import bans, missing, settings, thresholds_of

RULES: Final = {"sequential": "", "paper": "paper_rule", "seconds": "seconds_rule"}
"""Rule of the firewall to the field of its figures; the default's stand at the top."""
TRAINING_S: Final = 3_600.0
BENIGN_S: Final = 5_400.0
"""Benign traffic before an attack begins, training included."""
ATTACK_S: Final = BENIGN_S + 60
LONGEST_S: Final = 120.0
"""Of an attack that is looked at."""
NOVELTY_S: Final = 900.0
REAL_TRAINING: Final = 12_000
"""Packets of the real capture that are training, as in `sdnator replay`."""
FLOOD_S: Final = 12.0
"""Of a flood that FastNetMon gets, behind five seconds of benign traffic."""
WAITING: Final = 6
"""FastNetMon takes the captures' own time, so that several hardly need more than one."""
Figures = dict[str, Any]
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
    parser.add_argument("--only", default="", help="attacks and novelty whose name contains this text")
    parser.add_argument("--no-fastnetmon", action="store_true", help="leave FastNetMon out, which needs root")
    add_data_option(parser)
    chosen = parser.parse_args(argv)
    begun = monotonic()
    figures: Figures = {
        "machine": measure.machine(),
        "settings": {
            key: str(value) if isinstance(value, Path) else value for key, value in vars(chosen).items()
        },
    }
    captured = _captured(chosen.data)
    figures["captured"] = len(captured) if captured else f"not run: no data in {chosen.data}"
    if not captured:
        print(f"captured attacks: {figures['captured']}", flush=True)
    rows: dict[str, list[Figures]] = {rule: [] for rule in chosen.rules}
    novelty: dict[str, list[Figures]] = {rule: [] for rule in chosen.rules}
    for name in chosen.networks:
        attacks, novelties = _network(name, chosen)
        for rule in chosen.rules:
            rows[rule] += attacks[rule]
            novelty[rule] += novelties[rule]
            _print_attacks(rule, attacks[rule])
        print(f"{name}: done after {monotonic() - begun:.0f} s", flush=True)
    days = _days(chosen)
    figures["fastnetmon"] = "not asked for" if chosen.no_fastnetmon else _fastnetmon(chosen)
    real = _real_benign(chosen)
    for rule, field in RULES.items():
        if rule in chosen.rules:
            its_days = [day["shared"] | day[rule] for day in days]
            found = _summary(rows[rule], novelty[rule], its_days) | {"real_benign": real[rule]}
            figures |= {field: found} if field else found
            _print(rule, found)
    figures["seconds"] = round(monotonic() - begun)
    print(f"took {figures['seconds']} s")
    measure.write_json(chosen.json, figures)
    return 0


def _print_attacks(rule: str, rows: list[Figures]) -> None:
    print(f"rule {rule}")
    columns = (
        "network",
        "attack",
        "seed",
        "s_to_decision",
        "stopped_share",
        "remedy",
        "wrong",
        "innocent_hosts",
    )
    measure.table(columns, [tuple(row[key] for key in columns) for row in rows])
    sys.stdout.flush()


def _print(rule: str, found: Figures) -> None:
    short = {key: value for key, value in found.items() if not key.startswith("by_")}
    print(json.dumps({"rule": rule} | short))
    for row in (*found["by_novelty"], *found["by_day"]):
        if row["blocks"]:
            print("  ", row)
    sys.stdout.flush()


def _summary(rows: list[Figures], novelty: list[Figures], days: list[Figures]) -> Figures:
    blocks = sum(day["blocks"] for day in days)
    seconds = [row["s_to_decision"] for row in rows]
    upper = float(chi2.ppf(0.95, 2 * (blocks + 1))) / 2
    return {
        "attacks": len(rows),
        "mitigated": sum(each <= SOON_S for each in seconds),
        "median_s_to_decision": statistics.median(seconds) if seconds else None,
        "stopped_share_median": statistics.median(row["stopped_share"] for row in rows) if rows else None,
        "innocent_blocks": sum(row["wrong"] for row in rows),
        "novelty_runs": len(novelty),
        "novelty_blocks": sum(row["blocks"] for row in novelty),
        "benign_days": len(days),
        "false_blocks_per_day": blocks / len(days) if days else None,
        "false_blocks_per_day_upper95": upper / len(days) if days else None,
        "by_attack": rows,
        "by_novelty": novelty,
        "by_day": days,
    }


def _rules(rule: str) -> Rules:
    return Rules(rule=rule)  # type: ignore[arg-type]


def _network(name: str, chosen: Any) -> tuple[dict[str, list[Figures]], dict[str, list[Figures]]]:
    """Train once, and run every attack under each rule, and every novelty, from there."""
    network = NETWORKS[name](1)
    known = [*ATTACKS, *_captured(chosen.data)]
    specs = [each for each in known if each.held_back == chosen.held_back and each.fits(network)]
    specs = [each for each in specs if chosen.only in each.name]
    specs = specs[: max(1, round(len(specs) * chosen.scale))]
    novelties = [each for each in NOVELTIES if chosen.only in each]
    novelties = novelties[: max(1, round(len(novelties) * chosen.scale))]
    if not specs and not novelties:
        nothing: dict[str, list[Figures]] = {rule: [] for rule in chosen.rules}
        return nothing, nothing
    benign = merge(*network.chunks(0, BENIGN_S + NOVELTY_S + 60))
    run = DecisionRun(len(benign.between(0, TRAINING_S)), _rules(chosen.rules[0]))
    run.feed(benign.between(0, TRAINING_S))
    seeds = range(1, chosen.seeds + 1)
    attacks = {
        rule: [
            {"network": name} | row
            for row in _apart(partial(_under_rule, rule, run, network, benign, specs, seeds))
        ]
        for rule in chosen.rules
    }
    runs = [DecisionRun(run.training_packets, _rules(rule), run.detector) for rule in chosen.rules]
    watch(runs, _from(benign, TRAINING_S, BENIGN_S))
    found = _all_apart(
        [partial(_novelty, runs, network, benign, which, seed) for which in novelties for seed in seeds]
    )
    return attacks, {
        rule: [{"network": name} | each["shared"] | each[rule] for each in found] for rule in chosen.rules
    }


def _captured(data: Path) -> Sequence[AttackSpec]:
    """The captured attacks, if their files are there."""
    return real_attacks(data) if data.exists() else ()


def _from(benign: Traffic, start_s: float, end_s: float, *more: Traffic) -> Traffic:
    """A part of the benign traffic, and what is on top of it, numbered as in one stream."""
    parts = (traffic.between(start_s, end_s) for traffic in (benign, *more))
    return renumbered(merge(*parts), len(benign.between(0, start_s)))


def _under_rule(
    rule: str,
    run: DecisionRun,
    network: Network,
    benign: Traffic,
    specs: Sequence[AttackSpec],
    seeds: Sequence[int],
) -> list[Figures]:
    run.decide_by(_rules(rule))
    run.feed(_from(benign, TRAINING_S, BENIGN_S))
    run.decided.clear()
    run.refused.clear()
    return _all_apart(
        [
            partial(_attack, run, network, benign, spec, seed)
            for spec in specs
            for seed in seeds
            if seed in spec.seeds or spec.seeds == (1, 2, 3)
        ]
    )


def _apart(work: Callable[[], Any]) -> Any:
    """Do it in a copy of this process, which alone can copy the detector's state."""
    return _all_apart([work])[0]


def _all_apart(works: Sequence[Callable[[], Any]], most: int = os.cpu_count() or 1) -> list[Any]:
    """Do each in a copy of this process, `most` at a time."""
    found: dict[int, Any] = {}
    going: dict[int, tuple[int, int]] = {}
    waiting = list(enumerate(works))[::-1]
    while waiting or going:
        while waiting and len(going) < most:
            number, work = waiting.pop()
            child, pipe = _copied(work)
            going[pipe] = (number, child)
        for pipe in select.select(list(going), [], [])[0]:
            number, child = going.pop(pipe)
            with os.fdopen(pipe, "rb") as reader:
                data = reader.read()
            if os.waitpid(child, 0)[1]:
                raise SystemExit("benchmarks.decisions: a run failed, see above")
            found[number] = pickle.loads(data)  # noqa: S301 - our own child's
    return [found[number] for number in range(len(works))]


def _copied(work: Callable[[], Any]) -> tuple[int, int]:
    """Start a copy of this process; returns its id, and the pipe that its result comes from."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        code = 1
        try:
            result = pickle.dumps(work())
            with os.fdopen(writer, "wb") as pipe:
                pipe.write(result)
            code = 0
        except BaseException:  # noqa: BLE001 - the copy must not go on as if it were this process
            traceback.print_exc()
        os._exit(code)
    os.close(writer)
    return child, reader


def _attack(run: DecisionRun, network: Network, benign: Traffic, spec: AttackSpec, seed: int) -> Figures:
    sent, truth = spec.traffic(network, seed, ATTACK_S)
    end = min(truth.last_us / 1e6 - BASE_US / 1e6, ATTACK_S + LONGEST_S) + 1
    traffic = _from(benign, BENIGN_S, end, sent)
    stopped = run.feed(traffic)
    mine = traffic.attack == truth.id
    first_ns = truth.first_us * 1_000
    good = [each for each in run.decided if _helps(each, truth)]
    wrong = [each for each in run.decided if not _helps(each, truth)]
    others = stopped & ~mine & ~_sent_by(traffic, truth, network.gateway.mac)
    hit = [traffic.columns[name][others & ~run.limited].tolist() for name in ("port", "eth_src", "ip_src_lo")]
    return {
        "attack": spec.name,
        "number": spec.number,
        "seed": seed,
        "s_to_decision": min(((each.time_ns - first_ns) / 1e9 for each in good), default=math.inf),
        "packets": int(mine.sum()),
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


def _novelty(runs: Sequence[DecisionRun], network: Network, benign: Traffic, name: str, seed: int) -> Figures:
    sent = NOVELTIES[name](network, seed, ATTACK_S)
    for run in runs:
        run.decided.clear()
    watch(runs, _from(benign, BENIGN_S, ATTACK_S + NOVELTY_S, sent))
    return {"shared": {"novelty": name, "seed": seed}} | _blocks(runs)


def _blocks(runs: Sequence[DecisionRun]) -> Figures:
    return {
        run.rules.rule: {
            "blocks": len(run.decided),
            "decisions": [each.reason for each in run.decided[:5]],
            "refused": len(run.refused),
            "bound": run.decider.test.bound,
        }
        for run in runs
    }


def _days(chosen: Any) -> list[Figures]:
    """Days of benign traffic after an hour of training: each of another network or seed."""
    names = [chosen.networks[number % len(chosen.networks)] for number in range(chosen.days)]
    return _all_apart(
        [
            partial(_day, chosen.rules, name, 11 + number // len(chosen.networks))
            for number, name in enumerate(names)
        ]
    )


def _day(rules: Sequence[str], name: str, seed: int) -> Figures:
    network = NETWORKS[name](seed)
    packets = sum(len(part) for part in network.chunks(0, TRAINING_S))
    detector = detector_for(packets)
    runs = [DecisionRun(packets, _rules(rule), detector) for rule in rules]
    benign = 0
    for part in network.chunks(0, TRAINING_S + 86_400):
        watch(runs, part)
        benign += len(part)
    found = _blocks(runs)
    print(
        f"day of {name}, seed {seed}: {benign:,} packets,",
        {rule: found[rule]["blocks"] for rule in rules},
        flush=True,
    )
    return {"shared": {"network": name, "seed": seed, "packets": benign}} | found


def _fastnetmon(chosen: Any) -> Figures | str:
    """FastNetMon on the floods of each network."""
    reason = missing()
    if reason:
        return reason
    rows: list[Figures] = []
    thresholds = {}
    for name in chosen.networks:
        network = NETWORKS[name](1)
        training = merge(*network.chunks(0, TRAINING_S))
        thresholds[name] = thresholds_of(training, network.prefix)
        benign = merge(*network.chunks(0, ATTACK_S + LONGEST_S))
        known = [*ATTACKS, *_captured(chosen.data)]
        floods = [each for each in known if each.kind == "flood" and chosen.only in each.name]
        floods = [each for each in floods if each.held_back == chosen.held_back and each.fits(network)]
        rows += _all_apart(
            [partial(_banned, network, benign, spec, thresholds[name]) for spec in floods], WAITING
        )
    _print_banned(rows)
    return {"settings": settings({}) | {"thresholds": thresholds}, "by_attack": rows}


def _banned(network: Network, benign: Traffic, spec: AttackSpec, thresholds: dict[str, int]) -> Figures:
    sent, truth = spec.traffic(network, 1, ATTACK_S)
    begin = (truth.first_us - BASE_US) / SECOND
    parts = (each.between(begin - 5, begin + FLOOD_S) for each in (benign, sent))
    found = bans(merge(*parts), f"{ipaddress.IPv4Address(network.prefix)}/24", thresholds)
    attackers = {str(ipaddress.IPv4Address(each.ip)) for each in truth.attackers if each.ip}
    victims = {str(ipaddress.IPv4Address(each)) for each in truth.victims}
    return {
        "network": network.name,
        "attack": spec.name,
        "s_to_ban": min((after for after, _ in found), default=math.inf),
        "banned": [
            "attacker" if host in attackers else "victim" if host in victims else "innocent"
            for _, host in found
        ],
    }


def _print_banned(rows: list[Figures]) -> None:
    columns = ("network", "attack", "s_to_ban", "banned")
    print("FastNetMon")
    measure.table(
        columns,
        [tuple(" ".join(row[key]) if key == "banned" else row[key] for key in columns) for row in rows],
    )


def _real_benign(chosen: Any) -> Figures:
    """The benign part of the real capture, behind the training that `sdnator replay` gives it."""
    if not chosen.data.exists():
        return dict.fromkeys(chosen.rules, f"not run: no data in {chosen.data}")
    benign = merge(*real_network(chosen.data).chunks(0, 3_600))
    detector = detector_for(REAL_TRAINING)
    runs = [DecisionRun(REAL_TRAINING, _rules(rule), detector) for rule in chosen.rules]
    watch(runs, benign)
    return {rule: {"packets": len(benign) - REAL_TRAINING} | found for rule, found in _blocks(runs).items()}


if __name__ == "__main__":
    sys.exit(main())
