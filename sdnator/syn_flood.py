"""`sdnator demo syn-flood`: a real SYN flood against a real TCP service, without the product and with it.

    1. client connects, flood starts, nobody protects       success must fall below 10 %, or all is void
    2. firewall and Sonata adapter start, the client becomes known, the same flood starts again

Everything happens in network namespaces that are removed at the end, also after Ctrl-C.
"""

import json
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

from sdnator import p4_program
from sdnator.errors import PipelineError
from sdnator.process import Child
from sdnator.syn_flood_frames import Sources
from sdnator.syn_flood_lab import BACKLOG, HALF_OPEN_S, PORT, Lab, mac
from sdnator.syn_flood_stage import Stage, begin

BUDGET_S: Final = 3.5
"""An attempt is one connect() of at most this long."""
VOID_FROM: Final = 0.1
"""Without the product the flood must leave fewer than this share of the attempts."""
_LATE_S: Final = 5.0
_CLEAR_S: Final = float(HALF_OPEN_S)
"""After a rule came into force the backlog is full for so long: nothing resets its half-open connections."""
_KNOWN: Final = 20
_LATENESS_US: Final = 20_000
"""One switch's packets come in order: windows need not wait long for late ones."""
_FIRST_NEW: Final = (4096, 20_480)


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
    unprotected_seconds: float = 6.0
    learning_seconds: float = 6.0
    known_rate: float = 10.0
    """Attempts a second of clients with a history."""
    new_rate: float = 3.0
    """Attempts a second, each from an address never seen before."""
    keep: Path | None = None
    """Folder for logs and reports; None: they are deleted."""


@dataclass(frozen=True)
class Attempt:
    """One connect()."""

    at: float
    kind: str
    ok: bool
    ms: float


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
    void: str = ""
    """Why the figures say nothing; empty for a valid run."""

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass
class Second:
    """One line of the table."""

    phase: str
    second: int
    tried: int
    succeeded: int
    half_open: int
    challenged: int


Show = Callable[[Second], None]


def run_syn_flood(options: SynFloodOptions, show: Show = lambda _: None) -> SynFloodResult:
    """Both phases.  Raises `BadInput` where the machine lacks something, `PipelineError` after a fault."""
    guard = {"reflected": {"rate": 4 * options.rate, "burst": options.rate}}
    with _terminable(), tempfile.TemporaryDirectory(prefix="sdnator-syn-flood-") as made:
        folder = options.keep or Path(made)
        with Lab(options.version) as lab, Stage(lab, folder, switch=options.switch, guard=guard) as stage:
            return _Run(options, lab, stage, show).run()


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM unwinds like Ctrl-C: namespaces outlive a process that just dies."""

    def leave(number: int, _: object) -> None:
        raise SystemExit(128 + number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class _Run:
    def __init__(self, options: SynFloodOptions, lab: Lab, stage: Stage, show: Show) -> None:
        self._options = options
        self._lab = lab
        self._stage = stage
        self._show = show
        self._result = SynFloodResult()
        self._counters = stage.report_path("counters")
        self._phase = ""

    def run(self) -> SynFloodResult:
        self._stage.host(
            "switch",
            "counters",
            {
                "grpc": self._stage.grpc,
                "device_id": 1,
                "p4info": str(p4_program.find().p4info),
                "every": 0.05,
                "entries_every": 20,
                "report": str(self._counters),
            },
        )
        self._unprotected()
        if self._result.void:
            return self._result
        self._protected()
        return self._result

    def _unprotected(self) -> None:
        self._phase = "without"
        victim, client, attempts = self._hosts(0)
        self._watch(2.0, attempts)
        first = self._flood(self._options.unprotected_seconds, attempts)
        self._watch(BUDGET_S, attempts)
        during = [
            each
            for each in _attempts(attempts)
            if first + 0.5 <= each.at <= first + self._options.unprotected_seconds - BUDGET_S
        ]
        self._result.client_success_unprotected = share = _success(during)
        if share is None or share >= VOID_FROM:
            what = "nothing was tried" if share is None else f"{share:.0%} of the attempts succeeded"
            self._result.void = f"without the product {what}: this flood harms nobody, the run is void"
        self._stage.release(client)
        self._stage.release(victim)

    def _protected(self) -> None:
        self._phase = "with"
        self._lab.flush_metrics()
        options = self._options
        service = (
            f"[{self._lab.plan.victim}]:{PORT}" if options.version == 6 else f"{self._lab.plan.victim}:{PORT}"
        )
        self._stage.app(
            "sonata_adapter", "apps.sonata_adapter.service", {"lateness_us": _LATENESS_US}
        ).wait_ready()
        self._stage.app(
            "firewall", "apps.firewall.service", {"guard": [service] if options.armed else []}
        ).wait_ready()
        _, _, attempts = self._hosts(1)
        self._watch(options.learning_seconds, attempts)
        first = self._flood(options.seconds, attempts)
        self._watch(BUDGET_S, attempts)
        self._judge(_attempts(attempts), first)

    def _judge(self, attempts: list[Attempt], first: float) -> None:
        result, end = self._result, first + self._options.seconds
        mitigated = self._mitigated(first)
        result.time_to_mitigate_ms = None if mitigated is None else round((mitigated - first) * 1000, 1)
        begun = first if self._options.armed else (mitigated or end) + _CLEAR_S
        counted = [each for each in attempts if begun <= each.at <= end]
        new = [each for each in counted if each.kind == "new"]
        result.known_client_success = _success([each for each in counted if each.kind == "known"])
        result.new_client_success = _success(new)
        result.new_connect_ms_p50 = (
            statistics.median(each.ms for each in new if each.ok) if _success(new) else None
        )
        result.entries_peak = max((line.get("entries", 0) for line in _lines(self._counters)), default=0)
        result.challenged = self._challenged()
        result.decisions = [
            f"{each.action} {each.target.address}: {each.reason}" for each in self._stage.decisions
        ]

    def _mitigated(self, first: float) -> float | None:
        """When the rule that helps was active: the first challenge, or the first confirmed decision."""
        if self._options.armed:
            return next(
                (line["at"] for line in _lines(self._counters) if line["at"] > first and _stopped(line)), None
            )
        return next(
            (
                at
                for at, said in self._stage.confirmed
                if at > first
                and said.action in ("block", "protect")
                and said.state in ("installed", "exists")
            ),
            None,
        )

    def _hosts(self, number: int) -> tuple[Child, Child, Path]:
        plan, options = self._lab.plan, self._options
        service = {"address": plan.victim, "port": PORT}
        victim = self._stage.host("victim", "victim", {**service, "backlog": BACKLOG})
        attempts = self._stage.report_path("attempts")
        client = self._stage.host(
            "client",
            "client",
            {
                **service,
                "prefix": plan.clients,
                "known": _KNOWN,
                "known_rate": options.known_rate,
                "new_rate": options.new_rate,
                "first_new": _FIRST_NEW[number],
                "budget": BUDGET_S,
                "report": str(attempts),
            },
        )
        return victim, client, attempts

    def _flood(self, seconds: float, attempts: Path) -> float:
        """Send for so long; the wall time of the first frame."""
        plan, report = self._lab.plan, self._stage.report_path("flood")
        flood = self._stage.host(
            "attacker",
            "flood",
            {
                "sources": self._options.sources,
                "rate": self._options.rate,
                "seconds": seconds,
                "victim": plan.victim,
                "victim_mac": mac("victim"),
                "attacker_mac": mac("attacker"),
                "port": PORT,
                "prefix": plan.attackers,
                "report": str(report),
            },
        )
        begin(flood)
        self._watch(seconds, attempts, flooding=True)
        said = self._flood_report(report)
        self._stage.release(flood)
        self._result.sent += said.get("sent", 0)
        return float(said["first"])

    def _flood_report(self, report: Path) -> dict[str, Any]:
        """When it began and what was sent; a flood may be late on a busy machine."""
        deadline = time.monotonic() + _LATE_S
        while True:
            lines = _lines(report)
            if lines and ("sent" in lines[-1] or time.monotonic() > deadline):
                return lines[-1]
            if time.monotonic() > deadline:
                raise PipelineError("the flood did not start")
            self._stage.wait(0.1)

    def _watch(self, seconds: float, attempts: Path, *, flooding: bool = False) -> None:
        begun = time.monotonic()
        phase = f"{self._phase} product, flood" if flooding else f"{self._phase} product"
        second = 0
        while (left := begun + seconds - time.monotonic()) > 0:
            since = time.time()
            self._stage.wait(min(1.0, left))
            half_open = self._lab.half_open()
            if flooding and self._phase == "with":
                self._result.half_open_peak = max(self._result.half_open_peak, half_open)
            ended = [each for each in _attempts(attempts) if each.at + each.ms / 1000 >= since]
            succeeded = sum(each.ok for each in ended)
            self._show(Second(phase, second, len(ended), succeeded, half_open, self._challenged()))
            second += 1

    def _challenged(self) -> int:
        lines = _lines(self._counters)
        return int(lines[-1].get("challenged", 0)) if lines else 0


def _stopped(line: dict[str, Any]) -> bool:
    return any(line.get(name, 0) > 0 for name in ("challenged", "cookie_sent", "over_last_meter"))


def _lines(path: Path) -> list[dict[str, Any]]:
    """Whole lines only: the writer may be in the middle of the last one."""
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]


def _attempts(path: Path) -> list[Attempt]:
    return [Attempt(**line) for line in _lines(path)]


def _success(attempts: list[Attempt]) -> float | None:
    return round(sum(each.ok for each in attempts) / len(attempts), 4) if attempts else None


NOTE: Final = (
    f"backlog and somaxconn {BACKLOG}, SYN cookies off, half-open connections live {HALF_OPEN_S} s, "
    f"tcp_no_metrics_save=1, an attempt is one connect() with {BUDGET_S} s"
)
