"""What is decided, how soon, and how often wrongly: `python -m benchmarks.decisions --json FILE`.

Detector and decisions alone (`benchmarks.decisions_core`) on generated networks (`benchmarks.decision_traffic`):
an hour of training, half an hour of benign traffic, and then, each in a process of its own that begins from the
trained state, every attack and every kind of benign novelty; then days of benign traffic.  The same for the rule
of the paper (block at the first score over the threshold) and the rule of seconds (five anomalous seconds of ten).

    attacks, mitigated        how many, and how many had an effective decision (block, guard, rate limit) within 5 s
    median_s_to_decision      capture seconds from the attack's first packet; an attack without any counts as endless
    stopped_share_median      share of the attack's packets that were dropped, over a rate limit, or challenged
    innocent_blocks           blocks during attacks of somebody who is not the attacker, the victim included
    novelty_blocks            blocks in benign novelty
    false_blocks_per_day, …_upper95   blocks a day of benign traffic, and the upper end of its 95 % interval
    captured                  how many captured attacks there are, held back or not; or why none
    real_benign               the benign part of the real capture: packets behind training, blocks
    ceiling                   share of the attacks that are within reach (`benchmarks.decision_reach`)
    unreachable, missed       attacks beyond it, and those within that were not mitigated in time, each with the reason
    by_attack                 with the packets dropped and challenged, and the packets and hosts of others that were hit;
                              `peak_score` and `over_1` are Kitsune's scores of the attack's packets, those dropped
                              apart: where none is over 1, the two other rules cannot block
    paper_rule, seconds_rule  the same under these rules
    fastnetmon                Debian's FastNetMon on the floods (seed 1), with its settings, or why it was not run
    seconds, cpu_seconds      what all of this took, on the clock and of all processors

Attacks are stopped under each rule for itself.  In days, novelty and the real capture all rules judge what one
detector says and nothing is stopped, which is the same where a rule blocks nobody, and spares two thirds of the time.

Attacks whose number is between 101 and 200 are held back: `--held-back` runs those instead, and captured ones that
are.  Not part of it: the switch, which counts SYNs itself and has floods of them guarded, and queries: whose results
are evidence, the setting `evidence_queries` says, and by default it names none.
"""

import ipaddress
import json
import math
import resource
import statistics
import sys
from collections.abc import Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from time import monotonic
from typing import Any, Final

from scipy.stats import chi2

from apps.firewall.policy.rules import Rules
from benchmarks import measure
from benchmarks.data_folder import add_data_option
from benchmarks.decision_jobs import Jobs
from benchmarks.decision_reach import SOON_S, missed, unreachable
from benchmarks.decision_rows import row_of
from benchmarks.decision_services import services_of
from benchmarks.decision_traffic.attacks import ATTACKS
from benchmarks.decision_traffic.network import Network
from benchmarks.decision_traffic.networks import NETWORKS
from benchmarks.decision_traffic.novelty import NOVELTIES
from benchmarks.decision_traffic.real import real_attacks, real_network
from benchmarks.decision_traffic.traffic import BASE_US, SECOND, Traffic, merge, renumbered
from benchmarks.decision_traffic.truth import AttackSpec
from benchmarks.decisions_core import DecisionRun, detector_for, feed_apart, watch
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
ByRule = dict[str, list[Figures]]


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
    begun, jobs = monotonic(), Jobs()
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
    # the longest first; networks become many short pieces of work, which end at the same time
    days = [partial(_day, chosen.rules, *each) for each in _seeds_of_days(chosen)]
    networks = [partial(_network, name, chosen, jobs) for name in chosen.networks]
    done = jobs.all([*days, *networks, partial(_real_benign, chosen)])
    of_days, of_networks, real = done[: len(days)], done[len(days) : -1], done[-1]
    print(f"days, networks and the real capture: done after {monotonic() - begun:.0f} s", flush=True)
    figures["fastnetmon"] = "not asked for" if chosen.no_fastnetmon else _fastnetmon(chosen)
    for rule, field in RULES.items():
        if rule in chosen.rules:
            rows = [row for attacks, _ in of_networks for row in attacks[rule]]
            novelty = [row for _, novelties in of_networks for row in novelties[rule]]
            its_days = [day["shared"] | day[rule] for day in of_days]
            _print_attacks(rule, rows)
            found = _summary(rows, novelty, its_days) | {"real_benign": real[rule]}
            figures |= {field: found} if field else found
            _print(rule, found)
    figures["seconds"] = round(monotonic() - begun)
    figures["cpu_seconds"] = round(_cpu_seconds())
    print(f"took {figures['seconds']} s, and {figures['cpu_seconds']} s of processors")
    measure.write_json(chosen.json, figures)
    return 0


def _cpu_seconds() -> float:
    """Of this process and all its copies."""
    spent = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in spent)


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
    lists = ("by_attack", "by_novelty", "by_day", "unreachable", "missed")
    print(json.dumps({"rule": rule} | {key: value for key, value in found.items() if key not in lists}))
    for field in ("unreachable", "missed"):
        for row in found[field]:
            print(f"   {field}: {row['network']}, {row['attack']}, seed {row['seed']}: {row['reason']}")
    for row in (*found["by_novelty"], *found["by_day"]):
        if row["blocks"]:
            print("  ", row)
    sys.stdout.flush()


def _summary(rows: list[Figures], novelty: list[Figures], days: list[Figures]) -> Figures:
    blocks, beyond = sum(day["blocks"] for day in days), unreachable(rows)
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
        "ceiling": (len(rows) - len(beyond)) / len(rows) if rows else None,
        "unreachable": beyond,
        "missed": missed(rows),
        "by_attack": rows,
        "by_novelty": novelty,
        "by_day": days,
    }


def _rules(rule: str) -> Rules:
    return Rules(rule=rule)  # type: ignore[arg-type]


def _network(name: str, chosen: Any, jobs: Jobs) -> tuple[ByRule, ByRule]:
    """Train once, and run every attack and every novelty from there, under all rules."""
    network = NETWORKS[name](1)
    known = [*ATTACKS, *_captured(chosen.data)]
    specs = [each for each in known if each.held_back == chosen.held_back and each.fits(network)]
    specs = [each for each in specs if chosen.only in each.name]
    specs = specs[: max(1, round(len(specs) * chosen.scale))]
    novelties = [each for each in NOVELTIES if chosen.only in each]
    novelties = novelties[: max(1, round(len(novelties) * chosen.scale))]
    if not specs and not novelties:
        nothing: ByRule = {rule: [] for rule in chosen.rules}
        return nothing, nothing
    benign = merge(*network.chunks(0, BENIGN_S + NOVELTY_S + 60))
    trained = DecisionRun(len(benign.between(0, TRAINING_S)), _rules(chosen.rules[0]))
    trained.feed(benign.between(0, TRAINING_S))
    services = services_of(benign.between(0, TRAINING_S))
    runs = [
        DecisionRun(trained.training_packets, _rules(rule), trained.detector, services)
        for rule in chosen.rules
    ]
    seeds = range(1, chosen.seeds + 1)
    attacks, found = jobs.all(
        [
            partial(_attacks, runs, network, benign, specs, seeds, jobs),
            partial(_novelties, runs, network, benign, novelties, seeds, jobs),
        ]
    )
    return (
        {rule: [{"network": name} | row for row in attacks[rule]] for rule in chosen.rules},
        {rule: [{"network": name} | each["shared"] | each[rule] for each in found] for rule in chosen.rules},
    )


def _captured(data: Path) -> Sequence[AttackSpec]:
    """The captured attacks, if their files are there."""
    return real_attacks(data) if data.exists() else ()


def _from(benign: Traffic, start_s: float, end_s: float, *more: Traffic) -> Traffic:
    """A part of the benign traffic, and what is on top of it, numbered as in one stream."""
    parts = (traffic.between(start_s, end_s) for traffic in (benign, *more))
    return renumbered(merge(*parts), len(benign.between(0, start_s)))


def _attacks(
    runs: Sequence[DecisionRun],
    network: Network,
    benign: Traffic,
    specs: Sequence[AttackSpec],
    seeds: Sequence[int],
    jobs: Jobs,
) -> ByRule:
    """Each attack with each of its seeds, behind the same benign traffic."""
    chosen = [
        (spec, seed) for spec in specs for seed in seeds if seed in spec.seeds or spec.seeds == (1, 2, 3)
    ]

    def attack(together: Sequence[DecisionRun]) -> ByRule:
        for run in together:
            run.decided.clear()
            run.refused.clear()
        rows = jobs.all([partial(_attack, together, network, benign, *each, jobs) for each in chosen])
        return {run.rules.rule: [row[run.rules.rule] for row in rows] for run in together}

    return feed_apart(runs, _from(benign, TRAINING_S, BENIGN_S), jobs, attack)


def _novelties(
    runs: Sequence[DecisionRun],
    network: Network,
    benign: Traffic,
    names: Sequence[str],
    seeds: Sequence[int],
    jobs: Jobs,
) -> list[Figures]:
    """Each benign novelty with each seed, behind the same benign traffic."""
    watch(runs, _from(benign, TRAINING_S, BENIGN_S))
    return jobs.all(
        [partial(_novelty, runs, network, benign, name, seed) for name in names for seed in seeds]
    )


def _attack(
    runs: Sequence[DecisionRun],
    network: Network,
    benign: Traffic,
    spec: AttackSpec,
    seed: int,
    jobs: Jobs,
) -> dict[str, Figures]:
    sent, truth = spec.traffic(network, seed, ATTACK_S)
    end = min(truth.last_us / 1e6 - BASE_US / 1e6, ATTACK_S + LONGEST_S) + 1
    traffic = _from(benign, BENIGN_S, end, sent)

    def told(together: Sequence[DecisionRun]) -> dict[str, Figures]:
        return {
            run.rules.rule: row_of(run, traffic, truth, network, TRAINING_S)
            | {"number": spec.number, "seed": seed}
            for run in together
        }

    return feed_apart(runs, traffic, jobs, told)


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


def _seeds_of_days(chosen: Any) -> list[tuple[str, int]]:
    """Each day is of another network or seed."""
    networks = chosen.networks
    return [(networks[day % len(networks)], 11 + day // len(networks)) for day in range(chosen.days)]


def _day(rules: Sequence[str], name: str, seed: int) -> Figures:
    """A day of benign traffic after an hour of training."""
    parts = NETWORKS[name](seed).chunks(0, TRAINING_S + 86_400)
    first = next(parts)  # training, an hour
    detector, services = detector_for(len(first)), services_of(first)
    runs = [DecisionRun(len(first), _rules(rule), detector, services) for rule in rules]
    benign = 0
    for part in chain([first], parts):
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
    works = []
    thresholds = {}
    for name in chosen.networks:
        network = NETWORKS[name](1)
        training = merge(*network.chunks(0, TRAINING_S))
        thresholds[name] = thresholds_of(training, network.prefix)
        benign = merge(*network.chunks(0, ATTACK_S + LONGEST_S))
        known = [*ATTACKS, *_captured(chosen.data)]
        floods = [each for each in known if each.kind == "flood" and chosen.only in each.name]
        floods = [each for each in floods if each.held_back == chosen.held_back and each.fits(network)]
        works += [partial(_banned, network, benign, spec, thresholds[name]) for spec in floods]
    rows = Jobs(WAITING).all(works)
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
    detector, services = detector_for(REAL_TRAINING), services_of(next(benign.batches(REAL_TRAINING)))
    runs = [DecisionRun(REAL_TRAINING, _rules(rule), detector, services) for rule in chosen.rules]
    watch(runs, benign)
    return {rule: {"packets": len(benign) - REAL_TRAINING} | found for rule, found in _blocks(runs).items()}


if __name__ == "__main__":
    sys.exit(main())
