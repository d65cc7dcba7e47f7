"""Seconds until a switch is as it should be again, after what broke: scenarios for `benchmarks.faults`.

Each starts Data Updates, Coordinator, switch and controller as processes, breaks one while decisions are
made, and compares what the switch then holds, and does to frames, with what was decided.
"""

import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np

from apps.p4runtime_ctrl.errors import SwitchError
from apps.p4runtime_ctrl.southbound.session import Address, CompiledProgram, P4RuntimeSession
from dataplane.ports.capture_port import CaptureFeed
from due import Capability, Engine
from p4rt import INSECURE, P4RuntimeStub
from sdnator.testing.cable import Cable
from sdnator.testing.controller_run import PACKETS, ControllerRun, Heard, block, frame
from sdnator.testing.product_program import program
from sdnator.testing.waiting import wait_for

Figures = dict[str, float | int | bool]

_DECISIONS: Final = Capability("network.block.firewall.*", delivery="reliable", archive="always")
_CUT_S: Final = 10.0
_LONGEST_S: Final = 60.0
_BEFORE: Final = range(1, 41)
"""Senders blocked before the fault; the first half is released, and others blocked, while it lasts."""
_RELEASED: Final = range(1, 21)
_LATE: Final = range(41, 61)
_WANTED: Final = frozenset((*_BEFORE, *_LATE)) - frozenset(_RELEASED)
_BURST: Final = 20


class Firewall:
    """Makes decisions, and hears what became of them."""

    def __init__(self, engine: Engine) -> None:
        self.heard = Heard(
            engine, PACKETS, "network.confirmation.p4runtime_ctrl.*", "network.switch.p4runtime_ctrl.s1"
        )
        self._engine = engine
        self._number = 0
        wait_for(lambda: engine.wanted("network.block.firewall.ipv4"), _LONGEST_S)

    def decide(self, sources: range, action: str = "block") -> None:
        for source in sources:
            self._number += 1
            value = block(self._number, source, action).to_value()
            self._engine.write("network.block.firewall.ipv4", value, event_time=self._number)
        self._engine.flush()

    def state(self) -> dict[str, object]:
        return (self.heard.values("network.switch") or [{}])[-1]

    def connected(self) -> bool:
        return bool(self.state().get("connected"))


class SenderTraffic:
    """`with Traffic(feed):` frames of 80 senders, one after the other, until the end."""

    def __init__(self, feed: CaptureFeed) -> None:
        self._feed = feed
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.sent = 0

    def __enter__(self) -> "SenderTraffic":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._done.wait(0.01):
            frames = [frame(1 + (self.sent + n) % 80) for n in range(_BURST)]
            try:
                self._feed.send(range(self.sent, self.sent + _BURST), [60] * _BURST, frames)
                self._feed.verdicts()
            except OSError:
                return  # the switch was killed
            self.sent += _BURST


def _blocked(address: str) -> frozenset[str] | None:
    """Senders that the switch drops, read from it; None while it does not answer."""
    where = Address(address, 1, 0, security=INSECURE)
    table = program().table("ingress.block_src").id
    with where.channel() as channel:
        session = P4RuntimeSession(
            P4RuntimeStub(channel), where, CompiledProgram(b"", program().message), None
        )
        try:
            return frozenset(program().describe(entry) for entry in session.read_counters(table))
        except SwitchError:
            return None


def _names(sources: frozenset[int] | range) -> frozenset[str]:
    return frozenset(f"ingress.block_src[is_ipv4=1,src=10.0.0.{source}]" for source in sources)


def _until(address: str, wanted: frozenset[str], firewall: Firewall) -> Figures:
    """Seconds from now until the switch drops exactly these; what is wrong where that takes too long."""
    began = time.monotonic()
    # BMv2 may end where it is read while it is given its program
    while not firewall.connected() and time.monotonic() - began < _LONGEST_S:
        time.sleep(0.01)
    found = _blocked(address)
    while found != wanted and time.monotonic() - began < _LONGEST_S:
        time.sleep(0.01)
        found = _blocked(address)
    held = found or frozenset()
    return {
        "restored_s": time.monotonic() - began,
        "stale": len(held - wanted),
        "missing": len(wanted - held),
    }


@contextmanager
def _ready(
    folder: Path, kind: str = "embedded", **options: object
) -> Iterator[tuple[ControllerRun, Firewall]]:
    """Everything started, packets wanted, the first blocks in force."""
    with ControllerRun(folder, kind=kind) as stage:
        stage.controller(**options)
        firewall = Firewall(stage.engine(capabilities=(_DECISIONS,)))
        wait_for(lambda: firewall.state().get("telemetry") == ["packets"], _LONGEST_S, why=stage.log)
        firewall.decide(_BEFORE)
        wait_for(lambda: _blocked(stage.target.address) == _names(_BEFORE), _LONGEST_S, why=stage.log)
        yield stage, firewall


def _change_mind(firewall: Firewall) -> None:
    firewall.decide(_RELEASED, "unblock")
    firewall.decide(_LATE)


def _verdicts(stage: ControllerRun) -> Figures:
    """Frames of every sender: how many met the wrong fate."""
    feed = stage.feed()
    senders = range(1, 81)
    feed.send([1 << 40] * len(senders), [60] * len(senders), [frame(each) for each in senders])
    got = b""
    deadline = time.monotonic() + _LONGEST_S
    while len(got) < len(senders) and time.monotonic() < deadline:
        got += feed.verdicts()
        time.sleep(0.01)
    feed.close()
    dropped = {sender for sender, verdict in zip(senders, got, strict=False) if not verdict}
    return {
        "wrongly_blocked": len(dropped - _WANTED),
        "wrongly_passed": len(_WANTED - dropped),
    }


def _doubles(firewall: Firewall) -> Figures:
    """Packets that came twice, or out of order."""
    arrivals = firewall.heard.arrivals().astype(np.int64)
    return {"packets": len(arrivals), "duplicates": int((np.diff(arrivals) <= 0).sum())}


def _switch_killed(folder: Path, kind: str) -> Figures:
    with _ready(folder, kind) as (stage, firewall):
        stage.target.kill()
        wait_for(lambda: not firewall.connected(), _LONGEST_S, why=stage.log)
        _change_mind(firewall)
        time.sleep(2)
        stage.target.start()
        figures = _until(stage.target.address, _names(_WANTED), firewall)
        wait_for(
            lambda: firewall.state().get("telemetry") == ["packets"] and firewall.connected(), _LONGEST_S
        )
        return figures | (_verdicts(stage) if kind == "embedded" else {})


def switch_killed(folder: Path) -> Figures:
    """kill -9 of the embedded switch; seconds from when it serves again."""
    return _switch_killed(folder, "embedded")


def switch_killed_bmv2(folder: Path) -> Figures:
    """The same with BMv2; `found` false where it is not installed."""
    if shutil.which("simple_switch_grpc") is None:
        return {"found": False}
    return {"found": True, **_switch_killed(folder, "bmv2")}


def controller_killed(folder: Path) -> Figures:
    """kill -9 of the controller under traffic; `restart_s` from the start of the next one's process,
    `restored_s` from when it is connected."""
    with _ready(folder) as (stage, firewall), SenderTraffic(stage.feed()):
        before = firewall.state()["brought_up_ms"]
        stage.kill(stage.processes[-1])
        _change_mind(firewall)
        time.sleep(2)
        began = time.monotonic()
        stage.controller()
        ready = time.monotonic() - began
        figures = _until(stage.target.address, _names(_WANTED), firewall)
        figures["restart_s"] = ready + figures["restored_s"]
        wait_for(lambda: firewall.state().get("brought_up_ms") != before, _LONGEST_S, why=stage.log)
        figures["restored_s"] = float(str(firewall.state()["brought_up_ms"])) / 1000
    return figures


def cable_cut(folder: Path) -> Figures:
    """No byte between controller and switch for 10 s, under traffic; seconds from when the cable is whole."""
    with ControllerRun(folder) as stage, Cable(stage.target.address) as cable:
        stage.switch_options["address"] = cable.address
        stage.controller()
        firewall = Firewall(stage.engine(capabilities=(_DECISIONS,)))
        wait_for(lambda: firewall.state().get("telemetry") == ["packets"], _LONGEST_S, why=stage.log)
        firewall.decide(_BEFORE)
        wait_for(lambda: _blocked(stage.target.address) == _names(_BEFORE), _LONGEST_S, why=stage.log)
        with SenderTraffic(stage.feed()) as traffic:
            cable.cut()
            began = time.monotonic()
            _change_mind(firewall)
            time.sleep(_CUT_S - (time.monotonic() - began))
            cable.mend()
            figures = _until(stage.target.address, _names(_WANTED), firewall)
            before = len(firewall.heard.arrivals())
            wait_for(lambda: len(firewall.heard.arrivals()) > before, _LONGEST_S, why=stage.log)
        figures["sent"] = traffic.sent
        figures["lost"] = int(str(firewall.state()["lost"]))
        return figures | _doubles(firewall)


def closed_after_kill(folder: Path) -> Figures:
    """fail = closed: seconds from kill -9 of the controller until its wires are out of the switch."""
    with ControllerRun(folder, fail="closed") as stage:
        stage.controller()
        wires = program().table("ingress.forward_port").id
        where = Address(stage.target.address, 1, 0, security=INSECURE)
        with where.channel() as channel:
            session = P4RuntimeSession(
                P4RuntimeStub(channel), where, CompiledProgram(b"", program().message), None
            )
            wait_for(lambda: list(session.read_counters(wires)), _LONGEST_S, why=stage.log)
            stage.kill(stage.processes[-1])
            began = time.monotonic()
            wait_for(lambda: not list(session.read_counters(wires)), _LONGEST_S, why=stage.log)
            return {"closed_s": time.monotonic() - began}


SCENARIOS: dict[str, Callable[[Path], Figures]] = {
    scenario.__name__: scenario
    for scenario in (switch_killed, switch_killed_bmv2, controller_killed, cable_cut, closed_after_kill)
}
"""Name to scenario; the folder that each is given is empty."""
