"""The highest rate at which `sdnator up` forwards and scores every packet: the part `live` of `benchmarks.replay`.

live_pps_lossless: `sdnator up` with its default settings on two veth interfaces, all apps running and Kitsune trained,
  under an office's traffic both ways, but for the SYNs that open connections (`office_lap` says why).  A rate holds where every frame that was offered came out at the other end (by
  the kernel's counters in the hosts' namespaces), no app says that it lost anything, and Kitsune has scored as many
  packets, the last of them at most LAG_S after the load; it has one retry.  Rates are found by bisection, and
  the figure is one that then held for `CONFIRM_S`.  0.0: none.
live_steps: all rates that were tried, with what came of them.
live_forward_pps: the embedded switch alone, forwarding between the same interfaces, without loss.
live_bmv2_pps: the same of BMv2, where `simple_switch_grpc` is installed.  It loses a frame now and then at any rate, so that
  often none holds for so long, and this is 0.
live_vs_bmv2: the highest rate of the embedded switch that held for `STEP_S` (`live_forward_step_pps`) by that of BMv2
  (`live_bmv2_step_pps`); `live_vs_bmv2_absent` says why it is missing.

Linux, root; elsewhere `live_absent`.
"""

import p4rt  # noqa: F401  # isort: skip  # before anything loads gRPC: it says how gRPC waits

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.replay_live_load import Offered, load_process
from benchmarks.replay_live_stage import HostWire, UpProcess, possible, wires
from benchmarks.soak_figures import lost_in
from benchmarks.switch_stage import SwitchProcess, primary, process, program
from benchmarks.switch_wire import bmv2_installed
from dataplane.bmv2 import PROGRAM, Bmv2
from sdnator.testing.p4runtime_client import EntryBuilder, insert

LAG_S: Final = 1.5
"""From the end of the load to Kitsune's report that all is scored; it reports once a second."""
STEP_S: Final = 5.0
CONFIRM_S: Final = 20.0
MOST_PPS: Final = 160_000.0
"""Above any rate that two cores carry, the load's own work included."""
LEAST_PPS: Final = 4_000.0
_NEAR: Final = 0.04
"""Bisection ends where the two rates are so close."""
_CONFIRMED: Final = (1.0, 0.96, 0.9, 0.8, 0.65)
"""Shares of the rate that was found, one after the other until one holds for longer."""
_OFFERED: Final = 0.97
"""A step that offers less of its rate says nothing about the rate: the load was too slow."""
_TRAINING_S: Final = 60.0
_SETTLED_S: Final = 2.5
"""Nothing is on its way any more where Kitsune's count stands still for so long."""
_DRAIN_S: Final = 60.0
_TOLD_S: Final = 1.2
"""Within so long every app has told what it lost."""
_POLL_S: Final = 0.05
_SEED: Final = 1
_APPS: Final = ("p4runtime_ctrl", "kitsune", "sonata_adapter", "firewall")


@dataclass(frozen=True)
class Step:
    """What came of one rate."""

    pps: float
    """Frames a second that were really offered."""
    wanted_pps: float
    sent: int
    came: int
    scored: int | None
    """None: nobody scores."""
    lag_s: float | None
    lost: Mapping[str, int]
    """What apps and interfaces say, where it is not 0."""
    blocks: int
    """In force; a sender that is blocked is no loss of the switch's, and no rate is found with it."""

    @property
    def holds(self) -> bool:
        whole = self.came == self.sent and not self.lost
        scored = self.scored is None or self.scored == self.sent
        in_time = self.lag_s is None or self.lag_s <= LAG_S
        return whole and scored and in_time and self.pps >= _OFFERED * self.wanted_pps


class LiveBench:
    """A load on two wires, and what becomes of it."""

    def __init__(self, pipe: Any, ends: tuple[HostWire, HostWire], up: UpProcess | None = None) -> None:
        self._pipe = pipe
        self._ends = ends
        self._up = up

    def step(self, pps: float, seconds: float) -> Step:
        """Offer a rate for so long, and wait until nothing is on its way."""
        before, scored, lost = self._counted(), self._scored(), self._lost()
        self._pipe.send((pps, seconds))
        offered: Offered = self._pipe.recv()
        sent = sum(offered.sent)
        lag = self._settle(scored + sent)
        time.sleep(_TOLD_S)
        after = self._counted()
        gone = {name: count - lost.get(name, 0) for name, count in self._lost().items()}
        gone["refused_by_wire"] = sent - (after["sent"] - before["sent"])
        return Step(
            pps=round(sent / offered.seconds, 1),
            wanted_pps=round(pps, 1),
            sent=sent,
            came=after["came"] - before["came"],
            scored=None if self._up is None else self._scored() - scored,
            lag_s=None if self._up is None else round(lag, 2),
            lost={name: count for name, count in gone.items() if count},
            blocks=0 if self._up is None else int(_app(self._up.health(), "firewall").get("blocks", 0)),
        )

    def train(self) -> None:
        """Load as fast as it goes until Kitsune is trained: nothing later is more than it has seen."""
        assert self._up is not None
        deadline = time.monotonic() + _TRAINING_S
        while not _app(self._up.health(), "kitsune").get("model", {}).get("done"):
            if time.monotonic() > deadline:
                raise SystemExit(f"live: Kitsune was not trained within {_TRAINING_S:.0f} s")
            self._pipe.send((MOST_PPS, 1.0))
            self._pipe.recv()
        self._settle(-1)

    def _settle(self, wanted: int) -> float:
        """Wait until so many packets are scored, or no more come; how long that took."""
        began = moved = time.monotonic()
        if self._up is None:
            time.sleep(_SETTLED_S)
            return 0.0
        last = self._scored()
        while (
            last != wanted and time.monotonic() - moved < _SETTLED_S and time.monotonic() - began < _DRAIN_S
        ):
            time.sleep(_POLL_S)
            if (now := self._scored()) != last:
                last, moved = now, time.monotonic()
        return time.monotonic() - began

    def _counted(self) -> dict[str, int]:
        found = [end.counted() for end in self._ends]
        return {name: sum(each[name] for each in found) for name in ("sent", "came")}

    def _scored(self) -> int:
        return 0 if self._up is None else int(_app(self._up.health(), "kitsune").get("packets", 0))

    def _lost(self) -> dict[str, int]:
        found = {"interfaces": sum(end.counted()["dropped"] for end in self._ends)}
        if self._up is None:
            return found
        health = self._up.health()
        switches = _app(health, "p4runtime_ctrl").get("switches", ())
        # a frame whose digest is incomplete is left out where its copy does not come
        return found | lost_in(health) | {"skipped": sum(int(each["skipped"]) for each in switches)}


def highest(attempt: Callable[[float, float], Step], scale: float) -> tuple[float, list[Step]]:
    """The highest rate that holds, by bisection; 0.0: not even the lowest.

    Args:
        attempt: offers a rate for so many seconds.
        scale: share of the seconds.
    """
    tried: list[Step] = []

    def held(pps: float, seconds: float) -> float:
        """What was really offered; 0.0 where it did not hold, twice."""
        for _ in range(2):
            tried.append(attempt(pps, seconds * scale))
            print(f"live: {_text(tried[-1])}", file=sys.stderr, flush=True)
            if tried[-1].holds:
                return tried[-1].pps
        return 0.0

    low, high, found = LEAST_PPS, MOST_PPS, 0.0
    while high / low > 1 + _NEAR:
        middle = (low * high) ** 0.5
        low, high = (middle, high) if held(middle, STEP_S) else (low, middle)
    for share in _CONFIRMED:
        found = found or held(share * low, CONFIRM_S)
    return found, tried


def _text(step: Step) -> str:
    scored = "" if step.scored is None else f", {step.scored:,} scored, the last after {step.lag_s} s"
    lost = f", lost {dict(step.lost)}" if step.lost else ""
    blocks = f", {step.blocks} blocks" if step.blocks else ""
    return (
        f"{step.pps:9,.0f} frames/s {'hold' if step.holds else 'do not hold'}: {step.sent:,} sent,"
        f" {step.came:,} came{scored}{lost}{blocks}"
    )


def live(folder: Path, scale: float = 1.0) -> dict[str, Any]:
    """All fields of the part.

    Args:
        folder: for the pipeline's state; empty.
        scale: share of the seconds of each step.
    """
    if not possible():
        return {"live_absent": "network namespaces need Linux, root and `ip`"}
    folder.mkdir(parents=True, exist_ok=True)
    found: dict[str, Any] = {}
    with _load() as (pipe, ends), UpProcess(folder, *_ports(ends)) as up:
        bench = LiveBench(pipe, ends, up)
        _wait_for_apps(up)
        bench.train()
        found["live_pps_lossless"], steps = highest(bench.step, scale)
        found["live_steps"] = [asdict(each) | {"holds": each.holds} for each in steps]
    found["live_forward_pps"], ours = _forwarding("embedded", folder / "embedded", scale)
    if not bmv2_installed():
        return found | {"live_vs_bmv2_absent": f"{PROGRAM} is not installed"}
    found["live_bmv2_pps"], theirs = _forwarding("bmv2", folder / "bmv2", scale)
    return found | compared(ours, theirs)


def compared(ours: Sequence[Step], theirs: Sequence[Step]) -> dict[str, Any]:
    """The fields that compare the embedded switch with BMv2, by the highest rate of each that held at all."""
    best = [max((step.pps for step in steps if step.holds), default=0.0) for steps in (ours, theirs)]
    found: dict[str, Any] = dict(zip(("live_forward_step_pps", "live_bmv2_step_pps"), best, strict=True))
    if not best[1]:
        return found | {"live_vs_bmv2_absent": f"BMv2 held no rate from {LEAST_PPS:,.0f} frames/s on"}
    return found | {"live_vs_bmv2": round(best[0] / best[1], 2)}


@contextmanager
def _load() -> Iterator[tuple[Any, tuple[HostWire, HostWire]]]:
    """The process that offers frames, and the two wires that it offers them to."""
    with wires() as ends:
        places = tuple((each.namespace, each.host) for each in ends)
        with process(load_process, places, _SEED) as pipe:
            yield pipe, ends


def _forwarding(kind: str, folder: Path, scale: float) -> tuple[float, list[Step]]:
    """The highest rate that a switch alone forwards both ways without loss, embedded or bmv2, and all that were tried."""
    with ExitStack() as stack:
        pipe, ends = stack.enter_context(_load())
        if kind == "bmv2":
            address = stack.enter_context(Bmv2({n: end.switch for n, end in enumerate(ends, 1)})).address
        else:
            switch = SwitchProcess(folder, _ports(ends))
            stack.callback(switch.close)
            address = switch.address
        controller = stack.enter_context(primary(address))
        names = EntryBuilder(program().p4info)
        for near, far in ((1, 2), (2, 1)):
            entry = names.entry("ingress.forward_port", {"ingress_port": near}, "ingress.to_port", [far])
            controller.write(insert(entry))
        return highest(LiveBench(pipe, ends).step, scale)


def _ports(ends: tuple[HostWire, HostWire]) -> list[str]:
    return [f"{number}=veth:{end.switch}" for number, end in enumerate(ends, 1)]


def _wait_for_apps(up: UpProcess) -> None:
    deadline = time.monotonic() + _TRAINING_S
    while not all(_app(up.health(), name) for name in _APPS):
        if time.monotonic() > deadline:
            raise SystemExit(f"live: not all apps run: {sorted(up.health().get('apps', {}))}")
        time.sleep(_POLL_S)


def _app(health: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """What an app itself told last; empty: nothing yet."""
    told: Mapping[str, Any] = health.get("apps", {}).get(name, {}).get("health", {}).get("app", {})
    return told
