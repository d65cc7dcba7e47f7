"""One SYN flood against one service while clients connect: what they saw, what the switch did, and when.

Only attempts count that began long enough before the flood's end to connect, and only if they did so
before it: the flood's end helps nobody.
"""

import ipaddress
import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

from apps.messages import Confirmation
from sdnator import p4_program
from sdnator.demos.syn_flood.frames import FloodPlan, Sources, flood_sources
from sdnator.demos.syn_flood.lab import BACKLOG, PLANS, PORT, mac
from sdnator.demos.syn_flood.records import Attempt, Records, Tail, success
from sdnator.demos.syn_flood.stage import FloodStage
from sdnator.errors import PipelineError

BUDGET_S: Final = 3.5
"""An attempt is one connect() of at most this long."""
FILLED_S: Final = 0.5
"""Without the product the backlog is full by then."""
NEEDED_S: Final = 2.0
"""With the product an attempt that begins less than this before the flood's end does not count."""
RECOVERED_S: Final = 2.0
"""Where the flood had to be found first, attempts count from so long after the rule."""
KNOWN: Final = 20
"""Clients with a history."""
STOPPED: Final = ("challenged", "cookie_sent", "over_last_meter")
_LATE_S: Final = 60.0
_BEFORE_S, _AFTER_S = 0.15, 0.2
"""Attempts begin before the flood; counters and confirmations are on their way after it."""
_LOOK_S: Final = 0.05
_FIRST_NEW: Final = 4096


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What to do."""

    sources: Sources
    version: int = 4
    service: int
    """Number of the service; each trial has its own."""
    seconds: float
    after_rule: float | None = None
    """End this many seconds after the rule, but after `seconds` at most."""
    rate: int = 5000
    """SYNs a second."""
    known_rate: float = 20.0
    new_rate: float = 5.0
    capture: str = ""
    as_recorded: bool = False
    protection: str = "armed"
    """none, armed, or found: by the firewall, as the service is not guarded beforehand."""

    @property
    def address(self) -> str:
        return PLANS[self.version].service(self.service)

    def plan(self) -> FloodPlan:
        """The frames to send; sources of their own for every trial."""
        networks = ipaddress.ip_network(PLANS[self.version].attackers).subnets(
            new_prefix=24 if self.version == 4 else 64
        )
        prefix = next(each for number, each in enumerate(networks) if number == self.service)
        return FloodPlan(
            sources=self.sources,
            rate=self.rate,
            seconds=self.seconds,
            victim=self.address,
            victim_mac=mac("victim"),
            attacker_mac=mac("attacker"),
            port=PORT,
            prefix=str(prefix),
            seed=self.service + 1000 * self.version,
            capture=self.capture,
            as_recorded=self.as_recorded,
        )


@dataclass(kw_only=True)
class TrialOutcome:
    """What was seen; shares are 0-1, None where nothing was tried; times are wall times."""

    trial: Trial
    first: float
    end: float
    sent: int
    latest_ms: float
    """How late a SYN was at most: a busy machine."""
    known_success: float | None
    new_success: float | None
    connect_ms: list[float] = field(repr=False)
    """Of the new clients' successful attempts."""
    half_open_peak: int
    challenged_ms: float | None
    """From the first SYN to the first that the guard kept back, as counters read now and then show it."""
    mitigated_ms: float | None
    """From the first SYN to the rule in the switch; None for a guard that was there before."""
    tried: int
    guarded_ms: float | None = None
    """From the first SYN to the service's guard."""
    blocked_ms: float | None = None
    """From the first SYN to the block of the last source."""

    @property
    def new_connect_ms_p50(self) -> float | None:
        return statistics.median(self.connect_ms) if self.connect_ms else None


Show = Callable[[], None]


class TrialHosts:
    """The hosts at work: they stay, each trial gives them new orders."""

    def __init__(self, stage: FloodStage, services: Iterable[str]) -> None:
        self.stage = stage
        told = {"services": list(services), "port": PORT, "backlog": BACKLOG}
        victim = stage.host("victim", "victim", told)
        prefixes = [plan.clients for plan in PLANS.values()]
        told = {"prefixes": prefixes, "known": KNOWN, "first_new": _FIRST_NEW, "budget": BUDGET_S}
        self._client = stage.host("client", "client", told)
        self._attacker = stage.host("attacker", "flood", {})
        p4info = str(p4_program.find().p4info)
        told = {"grpc": stage.grpc, "device_id": 1, "p4info": p4info, "every": 0.05, "entries_every": 10}
        counters = stage.host("switch", "counters", told)
        reports = (each.report for each in (self._client, victim, self._attacker, counters))
        client, half_open, flood, counted = (Tail(each) for each in reports)
        self.records = Records(client, half_open, flood, counted)

    def aim(self, address: str, *, known_rate: float, new_rate: float) -> None:
        """From now on clients connect to this service."""
        order = {"address": address, "port": PORT, "known_rate": known_rate, "new_rate": new_rate}
        self._client.order(order)

    def watch(self, seconds: float, show: Show | None = None) -> None:
        """Let time pass; `show` is called about every second."""
        begun = time.monotonic()
        self.wait_until(lambda: time.monotonic() >= begun + seconds, seconds + _LATE_S, "", show)

    def wait_until(
        self, true: Callable[[], bool], seconds: float, what: str, show: Show | None = None
    ) -> None:
        """Wait for something in the records; raises `PipelineError` naming what did not come."""
        begun, shown = time.monotonic(), 1.0
        while True:
            self.records.update()
            if true():
                return
            since = time.monotonic() - begun
            if since > seconds:
                raise PipelineError(f"waited {seconds:.0f} s for {what}, without success")
            if show is not None and since >= shown:
                show()
                shown += 1.0
            self.stage.wait(_LOOK_S)

    def learn(self, versions: Iterable[int], address: Callable[[int], str]) -> None:
        """Have the known clients connect until the switch lets them through as known."""
        for number, version in enumerate(versions, start=1):
            self.aim(address(version), known_rate=20.0, new_rate=0.0)
            known = partial(self._has_entries, "known_sources", number * KNOWN)
            self.wait_until(known, _LATE_S, "known sources in the switch")

    def wait_guarded(self, services: int) -> None:
        """Wait until this many services are guarded in the switch."""
        guarded = partial(self._has_entries, "protect", services)
        self.wait_until(guarded, _LATE_S, "guards in the switch")

    def _has_entries(self, table: str, wanted: int) -> bool:
        entries = self.records.entries()
        return bool(entries) and entries[-1][table] >= wanted

    def run(self, trial: Trial, show: Show | None = None) -> TrialOutcome:
        """Flood a service while clients connect."""
        address = trial.address
        self.aim(address, known_rate=trial.known_rate, new_rate=trial.new_rate)
        self.watch(_BEFORE_S)
        self._attacker.order(vars(trial.plan()))
        self.wait_until(lambda: self._is_over(trial), trial.seconds + _LATE_S, "the flood's end", show)
        self.aim(address, known_rate=0.0, new_rate=0.0)
        self.watch(_AFTER_S)
        return self._judge(trial, self.records.floods[address])

    def _is_over(self, trial: Trial) -> bool:
        said = self.records.floods.get(trial.address, {})
        if trial.after_rule is not None and said:
            mitigated = mitigation(self.stage.confirmed, trial, said["first"])
            if mitigated is not None and time.time() >= mitigated + trial.after_rule:
                self._attacker.order({})
        return "sent" in said

    def _judge(self, trial: Trial, said: dict[str, Any]) -> TrialOutcome:
        records, first = self.records, float(said["first"])
        end = first + float(said["seconds"])
        mitigated = mitigation(self.stage.confirmed, trial, first)
        counted = self._counted(trial, first, end, mitigated)
        new = [each for each in counted if each.kind == "new"]
        challenged = records.first_rise(STOPPED, first)
        return TrialOutcome(
            trial=trial,
            first=first,
            end=end,
            sent=said["sent"],
            latest_ms=round(said["latest_ms"], 1),
            known_success=success((each for each in counted if each.kind == "known"), end),
            new_success=success(new, end),
            connect_ms=[each.ms for each in new if each.connected_by(end)],
            half_open_peak=records.half_open_at(trial.address, first, end),
            challenged_ms=_since(first, challenged),
            mitigated_ms=_since(first, mitigated),
            tried=len(counted),
            guarded_ms=_since(first, mitigation(_of(self.stage.confirmed, "protect"), trial, first)),
            blocked_ms=_since(first, mitigation(_of(self.stage.confirmed, "block"), trial, first)),
        )

    def _counted(self, trial: Trial, first: float, end: float, mitigated: float | None) -> list[Attempt]:
        """Attempts that began while the outcome is what the trial asks for."""
        begin = {"none": first + FILLED_S, "armed": first}.get(
            trial.protection, (end if mitigated is None else mitigated) + RECOVERED_S
        )
        until = end - (BUDGET_S if trial.protection == "none" else NEEDED_S)
        return [each for each in self.records.towards(trial.address) if begin <= each.at <= until]


def _of(confirmed: Iterable[tuple[float, Confirmation]], action: str) -> list[tuple[float, Confirmation]]:
    return [each for each in confirmed if each[1].action == action]


def mitigation(confirmed: Iterable[tuple[float, Confirmation]], trial: Trial, first: float) -> float | None:
    """When the switch had said that the service is guarded, or that every source of the flood is blocked."""
    left = set(flood_sources(trial.plan()))
    for at, said in confirmed:
        if at < first or said.state not in ("installed", "exists") or said.target is None:
            continue
        if said.action == "protect" and said.target.address == trial.address:
            return at
        if said.action == "block" and said.target.kind != "mac" and left:
            network = ipaddress.ip_network(said.target.address, strict=False)
            left = {each for each in left if ipaddress.ip_address(each) not in network}
            if not left:
                return at
    return None


def _since(first: float, at: float | None) -> float | None:
    return None if at is None else round((at - first) * 1000, 1)
