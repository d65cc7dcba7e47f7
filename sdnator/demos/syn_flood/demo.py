"""`sdnator demo syn-flood`: a real SYN flood against a real TCP service, without the product and with it.

    1. clients connect, the flood starts, nobody protects     success must fall below 10 %, or all is void
    2. firewall and Sonata adapter start, clients become known, the same flood goes to a second address
       of the victim: with a backlog of its own, so that the first flood's is no excuse

Everything happens in network namespaces that are removed at the end, also after Ctrl-C.
"""

import signal
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from sdnator.demos.syn_flood.frames import Sources
from sdnator.demos.syn_flood.lab import HALF_OPEN_S, PLANS, PORT, Lab
from sdnator.demos.syn_flood.stage import SWITCH, FloodStage
from sdnator.demos.syn_flood.trial import BUDGET_S, Trial, TrialHosts, TrialOutcome

VOID_FROM: Final = 0.1
"""Without the product the flood must leave fewer than this share of the attempts."""
_LINEAR: Final = 3
_LEARNING, _UNPROTECTED, _PROTECTED = 1, 2, 3
"""Services of the victim."""


@dataclass(frozen=True, kw_only=True)
class SynFloodOptions:
    """What to run."""

    sources: Sources = "one"
    version: int = 4
    """IP version."""
    switch: str = "embedded"
    armed: bool = True
    """The service is guarded before the flood; else the firewall has to find out."""
    rate: int = 5000
    """SYNs a second."""
    seconds: float = 12.0
    unprotected_seconds: float = 5.0
    known_rate: float = 10.0
    """Attempts a second of clients with a history."""
    new_rate: float = 3.0
    """Attempts a second, each from an address never seen before."""
    capture: str = ""
    """Capture file of SYNs to send instead."""
    keep: Path | None = None
    """Folder for logs and reports; None: they are deleted."""


@dataclass(kw_only=True)
class SynFloodResult:
    """What was seen; shares are 0-1, None where nothing was tried."""

    client_success_unprotected: float | None = None
    known_client_success: float | None = None
    new_client_success: float | None = None
    new_connect_ms_p50: float | None = None
    half_open_peak: int = 0
    time_to_mitigate_ms: float | None = None
    entries_peak: int = 0
    challenged: int = 0
    sent: int = 0
    decisions: list[str] = field(default_factory=list)
    memory_mb: dict[str, float] = field(default_factory=dict)
    """Resident memory of the product's parts at the end."""
    kernel: dict[str, int] = field(default_factory=dict)
    """Settings of victim and client that decide how a flood hurts, as their kernel has them."""
    void: str = ""
    """Why the figures say nothing; empty for a valid run."""

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class Second:
    """One line of the table."""

    phase: str
    second: int
    tried: int
    succeeded: int
    half_open: int
    challenged: int
    rule: str = ""
    """What the switch has confirmed since the line before."""


@dataclass
class Told:
    """Who is told of what, as it happens."""

    kernel: Callable[[dict[str, int]], None] = lambda _: None
    second: Callable[[Second], None] = lambda _: None
    ended: Callable[[TrialHosts, list[TrialOutcome]], None] = lambda _field, _outcomes: None
    """With all records, before they go."""


def run_syn_flood(options: SynFloodOptions, told: Told | None = None) -> SynFloodResult:
    """Both phases.  Raises `BadInput` where the machine lacks something, `PipelineError` after a fault."""
    with terminable(), tempfile.TemporaryDirectory(prefix="sdnator-syn-flood-") as made:
        folder = (options.keep or Path(made)).absolute()
        with Lab() as lab, FloodStage(lab, folder, switch=options.switch, guard=guard(options.rate)) as stage:
            plan = PLANS[options.version]
            services = [plan.service(each) for each in (_LEARNING, _UNPROTECTED, _PROTECTED)]
            return _Run(options, TrialHosts(stage, services), told or Told()).run()


def guard(rate: int) -> dict[str, Any]:
    """Settings of the controller's guard: cookies are not capped below the flood."""
    return {"reflected": {"rate": 4 * rate, "burst": rate}}


@contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM unwinds like Ctrl-C, and a second of either does not stop the unwinding.

    Namespaces outlive a process that just dies.
    """
    signals = (signal.SIGINT, signal.SIGTERM)

    def leave(number: int, _: object) -> None:
        for each in signals:
            signal.signal(each, signal.SIG_IGN)
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = [signal.signal(each, leave) for each in signals]
    try:
        yield
    finally:
        for each, handler in zip(signals, before, strict=True):
            signal.signal(each, handler)


def start_product(stage: FloodStage, guarded: list[str], **firewall: Any) -> None:
    """Start adapter and firewall; services as ADDRESS:PORT are guarded from the start."""
    stage.start_apps({"sonata_adapter": {}, "firewall": {"guard": guarded, **firewall}})


def named(address: str) -> str:
    """A service as the firewall's settings name it."""
    return f"[{address}]:{PORT}" if ":" in address else f"{address}:{PORT}"


class _Run:
    def __init__(self, options: SynFloodOptions, field: TrialHosts, told: Told) -> None:
        self._options = options
        self._field = field
        self._told = told
        self._result = SynFloodResult(kernel=field.stage.lab.settings())
        self._outcomes: list[TrialOutcome] = []
        told.kernel(self._result.kernel)

    def run(self) -> SynFloodResult:
        outcome = self._flood("without the product", _UNPROTECTED, self._options.unprotected_seconds, "none")
        shares = [each for each in (outcome.known_success, outcome.new_success) if each is not None]
        self._result.client_success_unprotected = share = max(shares, default=None)
        if share is None or share >= VOID_FROM:
            what = "nothing was tried" if share is None else f"{share:.0%} of the attempts succeeded"
            self._result.void = f"without the product {what}: this flood harms nobody, the run is void"
        else:
            self._protected()
        self._told.ended(self._field, self._outcomes)
        return self._result

    def _protected(self) -> None:
        options, stage, result = self._options, self._field.stage, self._result
        plan = PLANS[options.version]
        stage.lab.flush_metrics()
        guarded = [named(plan.service(_PROTECTED))] if options.armed else []
        start_product(stage, guarded)
        self._field.wait_guarded(len(guarded))
        self._field.learn([options.version], lambda _: plan.service(_LEARNING))
        protection = "armed" if options.armed else "found"
        outcome = self._flood("with the product", _PROTECTED, options.seconds, protection)
        records = self._field.records
        result.known_client_success = outcome.known_success
        result.new_client_success = outcome.new_success
        result.new_connect_ms_p50 = outcome.new_connect_ms_p50
        result.half_open_peak = outcome.half_open_peak
        result.time_to_mitigate_ms = outcome.challenged_ms if options.armed else outcome.mitigated_ms
        result.entries_peak = max((sum(each.values()) for each in records.entries()), default=0)
        result.challenged = records.counter("challenged")
        result.memory_mb = stage.memory()
        result.decisions = [f"{each.action} {each.target.address}: {each.reason}" for each in stage.decisions]

    def _flood(self, phase: str, service: int, seconds: float, protection: str) -> TrialOutcome:
        options = self._options
        trial = Trial(
            sources=options.sources,
            version=options.version,
            service=service,
            seconds=seconds,
            rate=options.rate,
            known_rate=options.known_rate,
            new_rate=options.new_rate,
            capture=options.capture,
            protection=protection,
        )
        outcome = self._field.run(trial, _Lines(phase, trial.address, self._field, self._told.second).tell)
        self._result.sent += outcome.sent
        self._outcomes.append(outcome)
        return outcome


class _Lines:
    """Lines of the table, of one flood."""

    def __init__(self, phase: str, address: str, field: TrialHosts, tell: Callable[[Second], None]) -> None:
        self._phase = phase
        self._address = address
        self._field = field
        self._tell = tell
        self._second = 0
        self._since = time.time()
        self._confirmed = len(field.stage.confirmed)

    def tell(self) -> None:
        """The line of the last second."""
        records, now = self._field.records, time.time()
        attempts = records.towards(self._address)
        ended = [each for each in attempts if each.ok is not None and each.ended >= self._since]
        half_open = records.half_open[-1][1].get(self._address, 0) if records.half_open else 0
        line = Second(
            self._phase,
            self._second,
            len(ended),
            sum(bool(each.ok) for each in ended),
            half_open,
            records.counter("challenged"),
            self._rules(),
        )
        self._tell(line)
        self._second += 1
        self._since = now

    def _rules(self) -> str:
        said = self._field.stage.confirmed[self._confirmed :]
        self._confirmed += len(said)
        rules = [
            f"{each.action} {each.target.address}"
            for _, each in said
            if each.target is not None and each.state == "installed"
        ]
        return rules[0] + (f" and {len(rules) - 1} more" if len(rules) > 1 else "") if rules else ""


def note(kernel: dict[str, int]) -> str:
    """What decides how the flood hurts, for people."""
    repeats = "1, 2 and 3 s" if kernel.get("tcp_syn_linear_timeouts", 0) >= _LINEAR else "1 and 3 s"
    return (
        f"backlog {kernel['tcp_max_syn_backlog']}, somaxconn {kernel['somaxconn']}, "
        f"SYN cookies {kernel['tcp_syncookies']}, tcp_no_metrics_save {kernel['tcp_no_metrics_save']}, "
        f"SYN-ACK retries {kernel['tcp_synack_retries']} (half-open for {HALF_OPEN_S} s), "
        f"clients repeat their SYN after {repeats}, an attempt is one connect() of {BUDGET_S} s at most"
    )


def median(values: Any) -> float | None:
    """Of what is known."""
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


__all__ = ["SWITCH", "SynFloodOptions", "SynFloodResult", "Told", "run_syn_flood"]
