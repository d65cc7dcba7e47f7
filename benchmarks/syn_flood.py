"""SYN floods end to end: real packets, a real TCP service, network namespaces (root).

One stage runs for the whole benchmark: an embedded switch, the product around it, attacker, clients and
a victim with a service of its own for each round, so that no round finds another's backlog, hold time
or block.  For each kind of flood and both IP versions

    client_success_unprotected   before the product is started; all is void unless it is below 0.1
    known_, new_client_success,  the service is guarded beforehand: from the flood's first packet.  Attempts
    new_connect_ms_p50           count that begin 2 s before its end or earlier, as successes only if they
    half_open_peak               connected before its end
    time_to_guard_ms             nobody guards the service: first packet to the guard confirmed by the switch
    time_to_block_ms             the same, to the block of the last source
    time_to_mitigate_ms          the first of both; a flood that was not mitigated counts as endless
    found                        such a round's success from 2 s after the rule; `_worst`: of the worst round
    host_cpu_s_per_million_syns  processor time of the host while no guard stands (benchmarks.syn_flood_cost)

Medians of the rounds.  real_capture is the capture of the tests' data, re-timed to the same rate and
looped; `as_recorded` is one run at its own times.  After 555 s no round is begun any more, so that all ends
within 10 minutes; `rounds` and `found_rounds` say how many there were.
"""

import contextlib
import math
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from benchmarks.data_folder import add_data_option
from benchmarks.measure import arguments, machine, table, write_json
from benchmarks.syn_flood_cost import host_cost
from benchmarks.syn_flood_innocent import decisions_on, generated_day, public_capture
from sdnator.demos.syn_flood.demo import VOID_FROM, guard, median, named, start_product, terminable
from sdnator.demos.syn_flood.frames import Sources
from sdnator.demos.syn_flood.lab import PLANS, Lab
from sdnator.demos.syn_flood.records import success
from sdnator.demos.syn_flood.stage import FloodStage
from sdnator.demos.syn_flood.trial import Trial, TrialHosts, TrialOutcome

KINDS: Final[dict[str, Sources]] = {
    "one_source": "one",
    "hundred_sources": "hundred",
    "spoofed": "spoofed",
    "spoofed_repeating": "repeating",
    "real_capture": "capture",
}
FIELDS: Final = (
    "client_success_unprotected",
    "known_client_success",
    "new_client_success",
    "new_connect_ms_p50",
    "half_open_peak",
    "time_to_mitigate_ms",
    "entries_peak",
)
ROUNDS_IPV6: Final = 3
UNPROTECTED_S: Final = 4.7
ARMED_S: Final[dict[Sources, float]] = {
    "one": 4.2,
    "hundred": 4.2,
    "spoofed": 4.2,
    "repeating": 6.0,
    "capture": 10.5,
}
"""The repeating flood has no repeats for its first second; the capture begins again after 7.6 s."""
FOUND_S: Final = 4.0
"""At most, until the rule."""
AFTER_RULE_S: Final[dict[Sources, float]] = {"one": 5.2, "hundred": 5.2}
"""Others end with the rule: clients of a service that was not guarded beforehand are no figure of theirs."""
LOOPED_S: Final = 30.0
SETTLE_S: Final = 3.0
_LAST_ROUND_S: Final = 555.0
CROWD_RATE, CROWD_S = 250.0, 4.0
LEARNING, CROWD, RECORDED, UNPROTECTED, ARMED, FOUND = 1, 2, 3, 5, 20, 120
"""Numbers of the victim's services; rounds count on from theirs."""
_ROUNDS_MOST: Final = 10


@dataclass
class FloodFigures:
    """What was seen of one kind of flood in one IP version."""

    unprotected: float | None = None
    armed: list[TrialOutcome] = field(default_factory=list)
    found: list[TrialOutcome] = field(default_factory=list)
    entries_peak: int = 0

    def figures(self) -> dict[str, Any]:
        """The fields, and what they rest on."""
        armed, found = self.armed, self.found
        return {
            "client_success_unprotected": self.unprotected,
            "known_client_success": median(each.known_success for each in armed),
            "new_client_success": median(each.new_success for each in armed),
            "new_connect_ms_p50": median(each.new_connect_ms_p50 for each in armed),
            "half_open_peak": max((each.half_open_peak for each in armed), default=None),
            "time_to_mitigate_ms": median_or_endless([each.mitigated_ms for each in found]),
            "entries_peak": self.entries_peak,
            "known_client_success_worst": min((each.known_success or 0.0 for each in armed), default=None),
            "new_client_success_worst": min((each.new_success or 0.0 for each in armed), default=None),
            "guard_armed_first_challenge_ms": median(each.challenged_ms for each in armed),
            "time_to_guard_ms": median_or_endless([each.guarded_ms for each in found]),
            "time_to_guard_ms_worst": max((each.guarded_ms or math.inf for each in found), default=None),
            "time_to_block_ms": median_or_endless([each.blocked_ms for each in found]),
            "time_to_mitigate_ms_all": [each.mitigated_ms for each in found],
            "found": {
                "known_client_success": median(each.known_success for each in found),
                "new_client_success": median(each.new_success for each in found),
                "half_open_peak": max((each.half_open_peak for each in found), default=None),
                "known_client_success_worst": _least(each.known_success for each in found),
                "new_client_success_worst": _least(each.new_success for each in found),
            },
            "attempts": sum(each.tried for each in armed),
            "rounds": len(armed),
            "found_rounds": len(found),
            "syn_late_ms": max((each.latest_ms for each in armed + found), default=None),
        }


def _least(shares: Iterable[float | None]) -> float | None:
    """The worst round's share; rounds in which nothing was tried do not count."""
    return min((each for each in shares if each is not None), default=None)


def median_or_endless(values: Sequence[float | None]) -> float | None:
    """The median where None is endless; None for that, or for no values.

    >>> median_or_endless([300, None, 400]), median_or_endless([300, None, None])
    (400, None)
    """
    found = statistics.median([math.inf if value is None else value for value in values] or [math.inf])
    return found if found < math.inf else None


class Bench:
    """The rounds, on a running stage; none begins after `last`, monotonic seconds."""

    def __init__(self, field: TrialHosts, names: Sequence[str], rounds: int, data: Path, last: float) -> None:
        self._field = field
        self._last = last
        self._names = names
        self._rounds = {4: rounds, 6: min(rounds, ROUNDS_IPV6)}
        self._capture = str(data / "captures" / "synflood_spoofed.pcap")
        self.kinds = {(version, name): FloodFigures() for version in PLANS for name in names}
        self.settled = 0
        """Rounds that began with an idle product."""
        self.looped: TrialOutcome | None = None
        self.recorded: TrialOutcome | None = None

    def unprotected(self) -> None:
        """Every kind once, before the product is there."""
        for (version, name), kind in self.kinds.items():
            trial = self._trial(name, version, UNPROTECTED, 0, UNPROTECTED_S)
            outcome = self._run(replace(trial, protection="none", known_rate=30.0, new_rate=10.0))
            shares = [each for each in (outcome.known_success, outcome.new_success) if each is not None]
            kind.unprotected = max(shares, default=None)

    def armed(self) -> None:
        """All rounds against guarded services."""
        for number, version, name, kind in self._each_round():
            seconds = ARMED_S[KINDS[name]]
            if (version, name, number) == (4, "real_capture", 0):
                seconds = LOOPED_S
            outcome = self._run(self._trial(name, version, ARMED, number, seconds))
            kind.armed.append(outcome)
            self._count_entries(kind)
            if seconds == LOOPED_S:
                self.looped = outcome

    def found(self) -> None:
        """All rounds against services that nobody guards."""
        for number, version, name, kind in self._each_round():
            after = AFTER_RULE_S.get(KINDS[name], 0.0)
            trial = self._trial(name, version, FOUND, number, FOUND_S + after)
            self.settled += self._field.stage.settle(SETTLE_S)
            kind.found.append(self._run(replace(trial, after_rule=after, protection="found")))
            self._count_entries(kind)

    def _each_round(self) -> Iterator[tuple[int, int, str, FloodFigures]]:
        """The first of every kind, then the second: where time is short the last ones are missing."""
        for number in range(max(self._rounds.values())):
            for (version, name), kind in self.kinds.items():
                if number < self._rounds[version] and time.monotonic() < self._last:
                    yield number, version, name, kind

    def as_recorded(self) -> None:
        """The real flood at its own times."""
        trial = self._trial("real_capture", 4, RECORDED, 0, 24.0, first=0)
        self.recorded = self._run(replace(trial, as_recorded=True))

    def crowd(self) -> tuple[int, float | None]:
        """Ten times as many clients for some seconds: guards they lead to, and their success."""
        address = PLANS[4].service(CROWD)
        self._field.aim(address, known_rate=0.0, new_rate=CROWD_RATE)
        begun = time.time()
        self._field.watch(CROWD_S)
        self._field.aim(address, known_rate=0.0, new_rate=0.0)
        self._field.watch(1.5)
        attempts = [each for each in self._field.records.towards(address) if each.at >= begun]
        guarded = sum(each.target.address == address for each in self._field.stage.decisions)
        return guarded, success(attempts, time.time())

    def innocent_blocked(self) -> int:
        """Blocks of any client's address in the whole run."""
        blocks = [each.target for each in self._field.stage.decisions if each.action == "block"]
        addresses = [each.address for each in blocks if each.kind != "mac"]
        return sum(any(plan.is_client(each) for plan in PLANS.values()) for each in addresses)

    def guarded(self) -> list[str]:
        """The services to be guarded beforehand."""
        numbers = [RECORDED]
        for place in range(len(KINDS)):
            numbers += [ARMED + place * _ROUNDS_MOST + each for each in range(max(self._rounds.values()))]
        return [named(plan.service(number)) for plan in PLANS.values() for number in numbers]

    def _trial(
        self, name: str, version: int, base: int, number: int, seconds: float, *, first: int | None = None
    ) -> Trial:
        place = list(KINDS).index(name) if first is None else first
        service = base + (place if base == UNPROTECTED else place * _ROUNDS_MOST + number)
        return Trial(
            sources=KINDS[name],
            version=version,
            service=service,
            seconds=seconds,
            capture=self._capture if name == "real_capture" else "",
        )

    def _run(self, trial: Trial) -> TrialOutcome:
        outcome = self._field.run(trial)
        say = f"known {outcome.known_success}, new {outcome.new_success} of {outcome.tried}"
        when = f"challenged {outcome.challenged_ms}, rule {outcome.mitigated_ms} ms"
        backlog = f"half-open {outcome.half_open_peak}, late {outcome.latest_ms} ms"
        when += f", guard {outcome.guarded_ms}, block {outcome.blocked_ms} ms"
        print(
            f"IPv{trial.version} {trial.sources} {trial.protection}: {say}, {when}, {backlog}",
            file=sys.stderr,
        )
        return outcome

    def _count_entries(self, kind: FloodFigures) -> None:
        seen = self._field.records.entries()[-20:]
        kind.entries_peak = max([kind.entries_peak, *(sum(each.values()) for each in seen)])


@contextlib.contextmanager
def running(folder: Path) -> Iterator[FloodStage]:
    """The stage, without firewall and adapter."""
    with terminable(), Lab() as lab, FloodStage(lab, folder, switch="embedded", guard=guard(5000)) as stage:
        yield stage


def measure(names: Sequence[str], rounds: int, data: Path, keep: Path | None) -> dict[str, Any]:
    """All figures."""
    begun = time.monotonic()
    with (
        tempfile.TemporaryDirectory(prefix="sdnator-syn-bench-") as made,
        running(keep or Path(made)) as stage,
    ):
        services = [plan.service(number) for plan in PLANS.values() for number in range(1, 200)]
        field = TrialHosts(stage, services)
        bench = Bench(field, names, rounds, data, begun + _LAST_ROUND_S)
        bench.unprotected()
        stage.lab.flush_metrics()
        # several attacks in the time of one: the cap on decisions a minute is for people's real days
        start_product(stage, bench.guarded(), rules={"max_decisions_per_minute": 10_000})
        field.wait_guarded(len(bench.guarded()))
        field.learn(PLANS, lambda version: PLANS[version].service(LEARNING))
        memory = [stage.memory()]
        crowd, crowd_success = bench.crowd()
        bench.armed()
        if "real_capture" in names:
            bench.as_recorded()
        memory.append(stage.memory())
        bench.found()
        memory.append(stage.memory())
        kernel, firewall = stage.lab.settings(), stage.firewall
    days = _innocent(data)
    innocent = {name: found["block"] for name, found in days.items()}
    innocent |= {"flash_crowd": crowd, "clients": bench.innocent_blocked()}
    figures = {version: {name: bench.kinds[version, name].figures() for name in names} for version in PLANS}
    return {
        **figures[4],
        **host_cost(),
        "ipv6": figures[6],
        "innocent_blocks": sum(innocent.values()),
        "innocent": {**innocent, "flash_crowd_success": crowd_success},
        "innocent_guards": {name: found["protect"] for name, found in days.items()},
        "looped": _short(bench.looped),
        "as_recorded": _short(bench.recorded),
        "memory_mb": memory,
        "found_rounds_begun_idle": bench.settled,
        "kernel": kernel,
        "firewall": firewall,
        "seconds": round(time.monotonic() - begun, 1),
    }


def _innocent(data: Path) -> dict[str, Counter[str]]:
    return {
        "public_capture": decisions_on(public_capture(data / "kitsune" / "mirai_38k.tsv.gz")),
        "generated_days": decisions_on(generated_day(3000, 1)) + decisions_on(generated_day(3000, 2)),
    }


def _short(outcome: TrialOutcome | None) -> dict[str, Any] | None:
    if outcome is None:
        return None
    names = ("known_success", "new_success", "new_connect_ms_p50", "half_open_peak", "challenged_ms")
    told = {name: getattr(outcome, name) for name in (*names, "sent", "latest_ms", "tried")}
    return {**told, "seconds": round(outcome.end - outcome.first, 1)}


def main(argv: Sequence[str] | None = None) -> int:
    """Run all kinds; 1 where a run was void."""
    parser = arguments("syn_flood", __doc__, rounds=5)
    parser.add_argument("--only", choices=sorted(KINDS), action="append", help="only this kind; repeatable")
    add_data_option(parser)
    parser.add_argument("--keep", type=Path, help="folder to keep logs and reports in")
    chosen = parser.parse_args(argv)
    if not 1 <= chosen.rounds <= _ROUNDS_MOST:
        parser.error(f"--rounds: 1 to {_ROUNDS_MOST}")
    before = machine()
    names = [name for name in KINDS if not chosen.only or name in chosen.only]
    figures = measure(names, chosen.rounds, chosen.data, chosen.keep)
    for title, part in (("IPv4", figures), ("IPv6", figures["ipv6"])):
        print(title)
        table(("flood", *FIELDS), [(name, *(part[name][each] for each in FIELDS)) for name in names])
    memory = figures["memory_mb"]
    print("resident memory, MB: at the start", memory[0], "at the end", memory[-1])
    shares = [
        part[name]["client_success_unprotected"] for part in (figures, figures["ipv6"]) for name in names
    ]
    void = sum(share is None or share >= VOID_FROM for share in shares)
    write_json(chosen.json, {**figures, "void": void, "machine": before, "rounds": chosen.rounds})
    return 1 if void else 0


if __name__ == "__main__":
    sys.exit(main())
