"""Findings 7 to 9: a star of network namespaces around Data Updates, each app behind a link of its own.

    app ─veth─┐ tbf                tbf ┌─ relay ─ bridge ═══ hub: Valkey          (the hub's link is not shaped)
              └──────── wire ──────────┘

Links are limited by tbf; one-way latency comes from `paper_relay`, since kernels may have no netem.  Links get 100 Mb/s
where the machine carries the sum, else half of the undelayed capacity, shared evenly; the JSON says which.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from benchmarks.paper_findings import Measured
from benchmarks.paper_star_app import BATCH, MESSAGE_BYTES
from due.drivers.embedded_redis import server_program

LINK_MBIT: Final = 100.0
_HUB: Final = "10.77.0.1"
_PORT: Final = 6379
_START_S: Final = 240.0
_SETTLE_S: Final = 3.0
_WARM_S: Final = 10.0
"""From the start of the apps: windows fill, and TCP finds its rate."""
_ROOT: Final = Path(__file__).parents[1]
_MBIT: Final = MESSAGE_BYTES * 8 / 1e6


def figures(rounds: int, *, quick: bool) -> tuple[dict[int, dict[str, Measured]], dict[str, Any]]:
    """Findings 7 to 9 by number, and all cells; raises OSError, RuntimeError where namespaces cannot be made."""
    if os.geteuid() != 0:
        raise RuntimeError("network namespaces need root")
    pairs = (1, 4) if quick else (1, 10, 30)
    delays = (0.0, 0.05) if quick else (0.0, 0.01, 0.025, 0.05)
    seconds = 4.0 if quick else 6.0
    capacity = _capacity(pairs[-1], seconds)
    rate = min(LINK_MBIT, capacity / 2 / pairs[-1])
    cells = [cell for count in pairs for cell in _cells(count, delays, rate, seconds, rounds)]
    return _findings(cells, pairs), {
        "capacity_mbit": capacity,
        "link_mbit": rate,
        "scaled": rate < LINK_MBIT,
        "message_bytes": MESSAGE_BYTES,
        "batch": BATCH,
        "runs": cells,
    }


def _findings(cells: Sequence[dict[str, Any]], pairs: Sequence[int]) -> dict[int, dict[str, Measured]]:
    def sums(count: int, delay: float) -> list[float]:
        return [one["sum_mbit"] for one in cells if one["pairs"] == count and one["one_way_s"] == delay]

    most = pairs[-1]
    fall = [far / near for far, near in zip(sums(most, 0.05), sums(most, 0.0), strict=True)]
    best = max(statistics.median(sums(count, 0.0)) for count in pairs)
    jain = [one["jain"] for one in cells if one["pairs"] == most]
    return {
        7: {"sum_100ms_to_0ms": Measured(tuple(fall))},
        8: {"sum_at_most_pairs_to_best": Measured(tuple(one / best for one in sums(most, 0.0)))},
        9: {"jain": Measured(tuple(jain))},
    }


def _capacity(pairs: int, seconds: float) -> float:
    """Sum of all pairs without limits and latency, Mb/s."""
    with Star(pairs, 0.0) as star:
        star.set_delay(0.0)
        time.sleep(_WARM_S)
        return sum(star.rates(seconds))


def _cells(
    pairs: int, delays: Sequence[float], rate: float, seconds: float, rounds: int
) -> list[dict[str, Any]]:
    found = []
    with Star(pairs, rate) as star:
        time.sleep(_WARM_S)
        for _ in range(rounds):
            for delay in delays:
                star.set_delay(delay)
                time.sleep(_SETTLE_S)
                rates = star.rates(seconds)
                found.append(
                    {
                        "pairs": pairs,
                        "one_way_s": delay,
                        "round_trip_ms": star.round_trip_ms(busy=False),
                        "busy_round_trip_ms": star.round_trip_ms(busy=True),
                        "sum_mbit": sum(rates),
                        "jain": jain(rates),
                        "per_app_mbit": rates,
                    }
                )
    return found


def jain(values: Sequence[float]) -> float:
    """Jain's index of fairness, 1 for equal shares."""
    squares = sum(value * value for value in values)
    return sum(values) ** 2 / (len(values) * squares) if squares else 0.0


class Star:
    """Namespaces, links, relay, Valkey and the apps; a context manager that leaves nothing behind.

    Args:
        pairs: producers and consumers, each an app in a namespace of its own.
        mbit: limit of each link, Mb/s; 0: none.
    """

    def __init__(self, pairs: int, mbit: float) -> None:
        self._pairs, self._mbit = pairs, mbit
        self._name = f"sp{os.getpid()}"
        self._stack = ExitStack()
        self._counts: list[list[tuple[float, int]]] = [[] for _ in range(pairs)]

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._folder = stack.enter_context(tempfile.TemporaryDirectory())
            self._wire = self._namespace(stack, "w")
            self._hub = self._namespace(stack, "h")
            _ip("-n", self._wire, "link", "add", "star", "mtu", "9000", "type", "bridge")
            _ip("-n", self._wire, "link", "set", "star", "up")
            self._link(self._hub, "up0", f"{_HUB}/16", "hub0")
            _ip("-n", self._wire, "link", "set", "hub0", "master", "star")
            leaves = [self._leaf(stack, number) for number in range(2 * self._pairs + 1)]
            between = [f"x{number},y{number}" for number in range(len(leaves))]
            self._relay = self._start(
                stack, self._wire, [sys.executable, "-m", "benchmarks.paper_relay", *between]
            )
            self._serve(stack)
            self._run_apps(stack, leaves)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def set_delay(self, seconds: float) -> None:
        """One-way latency of every app's link."""
        if self._relay.stdin is not None:
            self._relay.stdin.write(f"{seconds}\n")
            self._relay.stdin.flush()

    def rates(self, seconds: float) -> list[float]:
        """What each consumer received from now on, Mb/s."""
        begun = time.monotonic()
        time.sleep(seconds)
        found = []
        for counts in self._counts:
            span = [one for one in list(counts) if one[0] >= begun]
            if len(span) < 2:
                raise RuntimeError("a consumer of the star said nothing")
            found.append((span[-1][1] - span[0][1]) / (span[-1][0] - span[0][0]) * _MBIT)
        return found

    def round_trip_ms(self, *, busy: bool) -> float:
        """Time to connect to the hub while all apps are at work, ms.

        Args:
            busy: over the first app's link, with what waits in it; else over a link that no app uses: the relay
                itself.
        """
        leaf = f"{self._name}l{0 if busy else 2 * self._pairs}"
        code = (
            "import socket, time; t = time.monotonic(); "
            f"socket.create_connection(('{_HUB}', {_PORT}), 30); print((time.monotonic() - t) * 1000)"
        )
        command = ["ip", "netns", "exec", leaf, sys.executable, "-c", code]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, timeout=60)
        return float(done.stdout)

    def _namespace(self, stack: ExitStack, suffix: str) -> str:
        name = f"{self._name}{suffix}"
        _ip("netns", "add", name)
        stack.callback(_ip, "netns", "del", name)
        _ip("-n", name, "link", "set", "lo", "up")
        return name

    def _link(self, namespace: str, inner: str, address: str, outer: str) -> None:
        _ip(
            "-n", namespace, "link", "add", inner, "mtu", "9000", "type", "veth",
            "peer", "name", outer, "mtu", "9000", "netns", self._wire,
        )  # fmt: skip
        _ip("-n", namespace, "addr", "add", address, "dev", inner)
        # frames pass through a program: their checksums must be there, and none may be longer than the MTU
        _inside(namespace, "ethtool", "-K", inner, "tx", "off", "tso", "off", "gso", "off", "gro", "off")
        _ip("-n", namespace, "link", "set", inner, "up")
        _ip("-n", self._wire, "link", "set", outer, "up")

    def _leaf(self, stack: ExitStack, number: int) -> str:
        leaf = self._namespace(stack, f"l{number}")
        self._link(leaf, "up0", f"10.77.{1 + number // 200}.{1 + number % 200}/16", f"x{number}")
        _ip(
            "-n", self._wire, "link", "add", f"y{number}", "mtu", "9000", "type", "veth",
            "peer", "name", f"z{number}", "mtu", "9000",
        )  # fmt: skip
        _ip("-n", self._wire, "link", "set", f"z{number}", "master", "star")
        for end in (f"y{number}", f"z{number}"):
            _ip("-n", self._wire, "link", "set", end, "up")
        if self._mbit:
            for namespace, device in ((leaf, "up0"), (self._wire, f"x{number}")):
                limit = ("rate", f"{self._mbit:.3f}mbit", "burst", "64kb", "latency", "100ms")
                _inside(namespace, "tc", "qdisc", "add", "dev", device, "root", "tbf", *limit)
        return leaf

    def _serve(self, stack: ExitStack) -> None:
        command = [server_program(), "--bind", _HUB, "--port", str(_PORT), "--protected-mode", "no"]
        self._start(stack, self._hub, [*command, "--save", "", "--dir", self._folder], says=False)
        end = time.monotonic() + _START_S
        probe = [
            "ip", "netns", "exec", self._hub, sys.executable, "-c",
            f"import socket; socket.create_connection(('{_HUB}', {_PORT}), 5)",
        ]  # fmt: skip
        while subprocess.run(probe, check=False, stderr=subprocess.DEVNULL, timeout=60).returncode:
            if time.monotonic() > end:
                raise RuntimeError("Valkey does not answer in the hub's namespace")

    def _run_apps(self, stack: ExitStack, leaves: Sequence[str]) -> None:
        url = f"redis://{_HUB}:{_PORT}/0"
        started = []
        for role, offset in (("consumer", 1), ("producer", 0)):
            some = []
            for pair in range(self._pairs):
                folder = f"{self._folder}/{role}{pair}"
                command = [sys.executable, "-m", "benchmarks.paper_star_app", role, url, str(pair), folder]
                some.append(self._start(stack, leaves[2 * pair + offset], command, says=False))
            for process in some:
                self._wait_ready(process)
            started.append(some)
        for process, counts in zip(started[0], self._counts, strict=True):
            threading.Thread(target=_follow, args=(process, counts), daemon=True).start()

    def _start(
        self, stack: ExitStack, namespace: str, command: Sequence[str], *, says: bool = True
    ) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            ["ip", "netns", "exec", namespace, "setpriv", "--pdeathsig", "KILL", *command],
            cwd=_ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        stack.callback(_end, process)
        if says:
            self._wait_ready(process)
        return process

    def _wait_ready(self, process: subprocess.Popen[str]) -> None:
        line = process.stdout.readline() if process.stdout is not None else ""
        if line.strip() != "ready":
            raise RuntimeError(f"a part of the star did not start: {line.strip() or 'it ended'}")


def _follow(process: subprocess.Popen[str], counts: list[tuple[float, int]]) -> None:
    for line in process.stdout or ():
        moment, count = line.split()
        counts.append((float(moment), int(count)))


def _end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait(30)
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            try:
                pipe.close()
            except OSError:
                continue


def _inside(namespace: str, *command: str) -> None:
    done = subprocess.run(
        ["ip", "netns", "exec", namespace, *command], check=False, capture_output=True, text=True, timeout=60
    )
    if done.returncode:
        raise OSError(f"{' '.join(command)} in {namespace}: {done.stderr.strip()[:300]}")


def _ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], check=False, capture_output=True, text=True, timeout=60)
    if done.returncode:
        raise OSError(f"ip {' '.join(arguments)}: {done.stderr.strip()[:300]}")
