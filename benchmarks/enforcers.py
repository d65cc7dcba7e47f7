"""How soon a decided block stops real packets, and how soon after its end they pass again: nftables and the switch.

`python -m benchmarks.enforcers --json FILE`.  Needs root, nft and network namespaces.

A sender sends a UDP packet every half millisecond through a host with nftables, or through an embedded switch with
two veth ports.  *Block* is the time from the firewall's `write` of the decision to the last packet that arrives,
*gone* the time from the `write` of its end to the first one that arrives again; *expiry* (nftables alone) the time
from the moment at which a block ends by itself, without anybody's word.  What the firewall needs to decide is not in it,
Data Updates, Coordinator (switch) and the enforcer are.  A round is one decision and its end.

In the switch a block ends by the firewall's word: *expiry* there is the time from the end that a decision names to the
confirmation that its entry is gone, with the real firewall, while packets of another sender pass and in silence.  The
blocked sender is silent, because a block of one that goes on sending is extended.
"""

import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Final, Protocol
from uuid import uuid4

from msgspec import structs

from apps.messages import Decision, Instruction, Target
from benchmarks.measure import arguments, bars, machine, table, write_json
from due import Capability, Item
from sdnator.capture.interfaces import VethPair
from sdnator.testing.controller_run import PACKETS, ControllerRun, frame
from sdnator.testing.enforcer_run import EnforcerRun
from sdnator.testing.routed_lab import FORWARD, SENDERS, RoutedLab
from sdnator.testing.switch_target import SwitchTarget
from sdnator.testing.waiting import wait_for

ROUNDS: Final = 100
EXPIRIES: Final = 10
EXPIRES_S: Final = 2.0
BAR_MS: Final = 1000.0
GAP_S: Final = 0.0005
INSTRUCTION: Final = "network.instruction.operator.firewall"
BLOCKS: Final = "network.block.firewall.*"
CONFIRMED: Final = "network.confirmation.p4runtime_ctrl.*"
STATE: Final = "network.switch.p4runtime_ctrl.*"
_CALM_S: Final = 0.05
"""No packet for this long: the block stands."""


class PacketPath(Protocol):
    """A way for packets."""

    def send(self) -> int: ...
    def came(self, seconds: float = 0.0) -> list[int]: ...


class Stream:
    """Packets, one every `gap_s` seconds, and when each was sent and arrived; a context manager."""

    def __init__(self, path: PacketPath, gap_s: float = GAP_S) -> None:
        self._path = path
        self._gap_s = gap_s
        self._stopping = threading.Event()
        self.last = 0.0
        """Monotonic time at which the last packet arrived."""
        self._threads = [threading.Thread(target=each, daemon=True) for each in (self._send, self._receive)]

    def __enter__(self) -> "Stream":
        for each in self._threads:
            each.start()
        wait_for(lambda: self.flows)
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        for each in self._threads:
            each.join()

    @property
    def flows(self) -> bool:
        """Whether packets arrive."""
        return time.monotonic() - self.last < _CALM_S

    def stopped_after(self, began: float) -> float:
        """Seconds from a moment to the last packet, once none comes any more."""
        wait_for(lambda: time.monotonic() - max(self.last, began) > _CALM_S)
        return max(0.0, self.last - began)

    def again_after(self, began: float) -> float:
        """Seconds from a moment to the next packet."""
        wait_for(lambda: self.last > began)
        return self.last - began

    def _send(self) -> None:
        while not self._stopping.wait(self._gap_s):
            self._path.send()

    def _receive(self) -> None:
        while not self._stopping.is_set():
            if self._path.came(0.05):
                self.last = time.monotonic()


class PathThroughSwitch:
    """Frames through a switch: in at one veth, out at another."""

    def __init__(self, near: str, far: str) -> None:
        self._in, self._out = (socket.socket(socket.AF_PACKET, socket.SOCK_RAW) for _ in range(2))
        self._in.bind((near, 0))
        self._out.bind((far, 0x0800))
        self._frame = frame(1)
        self._sent = 0

    def close(self) -> None:
        """Close both ends."""
        self._in.close()
        self._out.close()

    def send(self) -> int:
        """Send one frame."""
        self._in.send(self._frame)
        self._sent += 1
        return self._sent

    def came(self, seconds: float = 0.0) -> list[int]:
        """Whether frames have come; their number."""
        found: list[int] = []
        self._out.settimeout(seconds or 0.001)
        try:
            while True:
                self._out.recv(2048)
                found.append(len(found))
                self._out.settimeout(0.0)
        except (TimeoutError, BlockingIOError):
            return found


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, write; 1 if a figure misses the bar."""
    options = arguments("enforcers", __doc__, rounds=1).parse_args(argv)
    rounds = max(3, int(ROUNDS * options.scale))
    expiries = max(2, int(EXPIRIES * options.scale))
    figures: dict[str, float] = {}
    for name, stage in (("nftables", _nftables), ("switch", _switch)):
        with (
            tempfile.TemporaryDirectory() as folder,
            stage(Path(folder)) as (path, decide, make),
            Stream(path) as stream,
        ):
            stops, again = _rounds(stream, decide, make, rounds * options.rounds)
            figures |= _figures(f"{name}_block_ms", stops) | _figures(f"{name}_gone_ms", again)
            if name == "nftables":
                ends = [_expiry(stream, decide, make) for _ in range(expiries)]
                figures |= _figures("nftables_expiry_ms", ends)
    with tempfile.TemporaryDirectory() as folder:
        for name, ends in _switch_expiries(Path(folder), expiries).items():
            figures |= _figures(f"switch_expiry_{name}_ms", ends)
    table(("figure", "ms"), sorted(figures.items()))
    bars("milliseconds", {name: value for name, value in figures.items() if name.endswith("p99")})
    missed = [name for name, value in figures.items() if value > BAR_MS]
    print(
        f"\nbar: every figure at most {BAR_MS:.0f} ms: {'missed by ' + ', '.join(missed) if missed else 'held'}"
    )
    write_json(options.json, {"machine": machine(), "rounds": rounds * options.rounds, **figures})
    return int(bool(missed))


Decide = Callable[[Decision], object]
Make = Callable[[float], Decision]


def _rounds(stream: Stream, decide: Decide, make: Make, count: int) -> tuple[list[float], list[float]]:
    stops, again = [], []
    for _ in range(count):
        wait_for(lambda: stream.flows)
        block = make(600.0)
        began = time.monotonic()
        decide(block)
        stops.append(stream.stopped_after(began))
        began = time.monotonic()
        decide(structs.replace(block, action="unblock", event_time=time.time_ns()))
        again.append(stream.again_after(began))
    return stops, again


def _expiry(stream: Stream, decide: Decide, make: Make) -> float:
    """Seconds from the end of a block, that nobody announces, to the next packet."""
    wait_for(lambda: stream.flows)
    ends = time.monotonic() + EXPIRES_S
    decide(make(EXPIRES_S))
    stream.stopped_after(ends - EXPIRES_S)
    asked = time.monotonic()
    return max(0.0, asked + stream.again_after(asked) - ends)


def _figures(name: str, seconds: Sequence[float]) -> dict[str, float]:
    ordered = sorted(seconds)
    shares = {"p50": 0.5, "p99": 0.99}
    return {
        f"{name}_{label}": round(ordered[min(len(ordered) - 1, int(share * len(ordered)))] * 1000, 2)
        for label, share in shares.items()
    }


Stage = tuple[PacketPath, Decide, Make]


@contextmanager
def _nftables(folder: Path) -> Iterator[Stage]:
    """Sender, gateway with nftables, server."""
    with RoutedLab() as lab:
        inside = partial(lab.inside, "gateway")
        settings: dict[str, object] = {"place": "gateway"}
        with EnforcerRun(folder, "apps.enforcers.nftables.service", settings, inside) as run:
            run.start()
            with lab.path(FORWARD[4]) as path:
                yield path, run.decide, lambda seconds: run.block(SENDERS[4], seconds=seconds)


@contextmanager
def _switch_run(folder: Path) -> Iterator[tuple[ControllerRun, PathThroughSwitch]]:
    """An embedded switch between two veth pairs, its controller, and the Coordinator."""
    with ExitStack() as stack:
        first, second = (VethPair.make(stack, name) for name in ("bena", "benb"))
        run = ControllerRun(folder, forward={"1": 2, "2": 1})
        run.target = SwitchTarget("embedded", folder, ports=(f"1=veth:{first.far}", f"2=veth:{second.far}"))
        stack.enter_context(run)
        run.controller()
        wire = PathThroughSwitch(first.near, second.near)
        stack.callback(wire.close)
        yield run, wire


@contextmanager
def _switch(folder: Path) -> Iterator[Stage]:
    """Decisions straight to the switch's controller."""
    with _switch_run(folder) as (run, wire):
        made = [Capability("network.block.firewall.*", delivery="reliable", archive="always")]
        engine = run.engine("firewall", capabilities=made)

        def decide(decision: Decision) -> None:
            engine.write("network.block.firewall.ipv4", decision.to_value())
            engine.flush()

        yield wire, decide, _block_of_sender


class FirewallRun:
    """The real firewall beside the controller of a run; blocks by hand, and when their entries are gone."""

    def __init__(self, run: ControllerRun) -> None:
        run.run("apps.firewall.service", {"detect": False, "learn": False, "arp": "off"})
        self._operator = run.engine("operator", capabilities=[Capability(INSTRUCTION, delivery="reliable")])
        self._ends: dict[str, int] = {}
        self._removed: dict[str, int] = {}
        self._behind = 1 << 62
        """Wall time minus the switch's, ns: the least of all reports, which are never early."""
        for key, told in ((BLOCKS, self._decided), (CONFIRMED, self._confirmed), (STATE, self._stated)):
            run.engine(f"observer{len(key)}").observe(key).subscribe(told)

    def hear_time(self) -> None:
        """Wait until some reports have told how the switch's time and the wall's differ."""
        seen = self._reports + 3
        wait_for(lambda: self._reports >= seen)

    _reports = 0

    def end_of(self, address: str) -> float:
        """Seconds from the end of a block to the confirmation that its entry is gone."""
        order = Instruction(id=uuid4().hex, verb="block", subject=address, seconds=int(EXPIRES_S))
        before = set(self._ends)
        self._operator.write(INSTRUCTION, order.to_value())
        wait_for(lambda: self._ends.keys() - before)
        (made,) = self._ends.keys() - before
        wait_for(lambda: made in self._removed)
        return (self._removed[made] - self._ends[made] - self._behind) / 1e9

    def _decided(self, item: Item) -> None:
        if item.value["action"] == "block":
            self._ends[item.value["id"]] = item.value["expires"]

    def _confirmed(self, item: Item) -> None:
        if item.value["state"] == "removed":
            self._removed[item.value["id"]] = time.time_ns()

    def _stated(self, item: Item) -> None:
        if item.value["event_time"]:
            self._behind = min(self._behind, time.time_ns() - item.value["event_time"])
            self._reports += 1


def _switch_expiries(folder: Path, count: int) -> dict[str, list[float]]:
    with _switch_run(folder) as (run, wire):
        firewall = FirewallRun(run)
        run.engine("listener").observe(PACKETS).subscribe(
            lambda _: None
        )  # without one the switch sends no packet, and no time
        with Stream(wire, _CALM_S / 5):
            firewall.hear_time()
            found = {"busy": [firewall.end_of(f"10.0.1.{number}") for number in range(1, count + 1)]}
        return found | {"silent": [firewall.end_of(f"10.0.2.{number}") for number in range(1, count + 1)]}


def _block_of_sender(seconds: float) -> Decision:
    now = time.time_ns()
    return Decision(
        id=f"b{now:x}",
        action="block",
        switch="*",
        target=Target(kind="ip", address="10.0.0.1"),
        reason="a benchmark",
        event_time=now,
        expires=now + int(seconds * 1e9),
    )


if __name__ == "__main__":
    sys.exit(main())
