"""Two sites on both ends of a slow link, a bridge between them, and apps that write in both directions."""

import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Final, Self

from benchmarks.cluster_bridge_app import BEST_EFFORT, RELIABLE
from benchmarks.cluster_link import ADDRESSES, SlowLink, end_program
from benchmarks.cluster_stage import PartMissing
from due.drivers.embedded_redis import SUBSCRIBER_LIMIT, server_program
from due.drivers.redis_wire import Wire
from due.errors import UpdatesUnavailable
from due.private_files import write_private_json

ITEM_BYTES: Final = 1_000
DIRECTIONS: Final = {"to_far": ("near", "far"), "to_near": ("far", "near")}
"""Who writes, and who reads."""
KINDS: Final = ("reliable", "best_effort")
_PORT: Final = 6379
_WATCHDOG_S: Final = 300.0
_QUIET_S: Final = 30.0
"""What has not come by then is lost."""
_SOON_S: Final = 0.5
"""The apps tell more often than this how far they are."""
Line = dict[str, Any]


class SiteProgram:
    """A process that prints JSON lines and obeys orders.

    Args:
        process: with pipes.
        log: where its errors are.
    """

    def __init__(self, process: subprocess.Popen[bytes], log: Path) -> None:
        self.process = process
        self._log = log
        self.progress: Line = {}
        """The last line that nobody asked for."""
        self._answers: queue.Queue[Line] = queue.Queue()
        threading.Thread(target=self._follow, daemon=True).start()

    def answer(self) -> Line:
        """The next line that somebody asked for, such as that it is ready."""
        try:
            said = self._answers.get(timeout=_WATCHDOG_S)
        except queue.Empty:
            said = {}
        if not said:
            raise RuntimeError(
                f"{self._log.stem} said nothing or ended: {self._log.read_text(errors='replace')[-500:]}"
            )
        return said

    def ask(self, order: str) -> Line:
        """Send an order; what it answers."""
        self.tell(order)
        return self.answer()

    def tell(self, order: str) -> None:
        """Send an order that nothing answers."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{order}\n".encode())
        self.process.stdin.flush()

    def end(self) -> None:
        """kill -9."""
        end_program(self.process)

    def _follow(self) -> None:
        assert self.process.stdout is not None
        with suppress(OSError, ValueError):  # the pipe is closed when it is killed
            for line in self.process.stdout:
                said = json.loads(line)
                if {"ready", "marked", "flushed", "end"} & said.keys():
                    self._answers.put(said)
                else:
                    self.progress = said
        self._answers.put({})


class BridgeStage:
    """The link, a server and a Coordinator for each site, the bridge and the apps; a context manager.

    Args:
        folder: for archives, logs and credentials.
    """

    def __init__(self, folder: Path) -> None:
        self.link = SlowLink()
        self._folder = folder
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            try:
                stack.enter_context(self.link)
                server = server_program()
            except (OSError, RuntimeError, UpdatesUnavailable) as error:
                raise PartMissing(str(error)) from error
            for site in ADDRESSES:
                self._serve(stack, server, site)
            self._bridge = self._start_bridge()
            stack.callback(self._end_bridge)
            self.apps = {site: self._start_app(stack, site) for site in ADDRESSES}
            self._wait_wanted()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def load(self, reliable: float, best_effort: float, writers: Sequence[str] = tuple(ADDRESSES)) -> None:
        """Items a second from now on, at each of these sites."""
        for site in writers:
            self.apps[site].tell(f"load {reliable} {best_effort}")

    def mark(self) -> dict[str, Line]:
        """What the readers have got since the last mark, by direction."""
        return {name: self.apps[reader].ask("mark") for name, (_, reader) in DIRECTIONS.items()}

    def measure(self, seconds: float) -> dict[str, dict[str, Any]]:
        """What crosses in so many seconds of the present load, by direction."""
        self.mark()
        began, before, written = time.monotonic(), self.link.carried(), self._written()
        time.sleep(seconds)
        now, found, after = self._written(), self.mark(), self.link.carried()
        took = time.monotonic() - began
        measured = {}
        for name, (writer, reader) in DIRECTIONS.items():
            rate = (after[reader] - before[reader]) / took
            measured[name] = {
                "offered_items_s": sum(now[writer][kind] - written[writer][kind] for kind in KINDS) / took,
                "carried_items_s": sum(found[name]["got"][kind]["came"] for kind in KINDS) / took,
                "link_bytes_s": rate,
                "link_share": 8 * rate / (1e6 * self.link.mbit),
                "pause_ms": found[name]["got"]["reliable"]["pause_ms"],
                "latency": found[name]["latencies"],
            }
        return measured

    def cut(self, seconds: float) -> dict[str, float]:
        """Cut the link for so long; the longest pause of reliable items by direction, ms."""
        self.mark()
        self.link.cut()
        time.sleep(seconds)
        self.link.mend()
        return self._pauses()

    def kill_bridge(self, away_s: float = 1.0) -> dict[str, float]:
        """kill -9 of the bridge, which comes back after a while; pauses as with `cut`."""
        self.mark()
        self._end_bridge()
        time.sleep(away_s)
        self._bridge = self._start_bridge()
        return self._pauses()

    def wait_whole(self) -> None:
        """Return when what is written after the call has arrived, of both kinds in both directions."""
        self._wait_wanted()
        written = self._written()
        self._until(lambda: self._arrived(written, beyond=1), "nothing crosses the bridge")

    def drain(self) -> None:
        """Write no more, and return when all that was written has arrived, or nothing more comes."""
        self.load(0, 0)
        for app in self.apps.values():
            app.ask("flush")
        time.sleep(_SOON_S)
        written = self._written()
        came, changed = -1, time.monotonic()
        while not self._arrived(written) and time.monotonic() - changed < _QUIET_S:
            now = sum(app.progress["got"][kind]["came"] for app in self.apps.values() for kind in KINDS)
            if now != came:
                came, changed = now, time.monotonic()
            time.sleep(0.1)

    def sums(self) -> dict[str, Line]:
        """Let the apps end; what was written and has arrived, by direction."""
        for app in self.apps.values():
            app.tell("end")
        said = {site: app.answer() for site, app in self.apps.items()}
        return {name: _sums(said[writer], said[reader]) for name, (writer, reader) in DIRECTIONS.items()}

    def _wait_wanted(self) -> None:
        self._until(lambda: all(app.progress["wanted"] for app in self.apps.values()), "nothing is wanted")

    def _pauses(self) -> dict[str, float]:
        self.wait_whole()
        return {name: line["got"]["reliable"]["pause_ms"] for name, line in self.mark().items()}

    def _written(self) -> dict[str, dict[str, int]]:
        return {site: app.progress["written"] for site, app in self.apps.items()}

    def _arrived(self, written: dict[str, dict[str, int]], beyond: int = 0) -> bool:
        return all(
            self.apps[reader].progress["got"][kind]["newest"] >= written[writer][kind] - 1 + beyond
            for writer, reader in DIRECTIONS.values()
            for kind in KINDS
        )

    def _until(self, condition: Callable[[], bool], otherwise: str) -> None:
        end = time.monotonic() + _WATCHDOG_S
        while not condition():
            if time.monotonic() > end:
                raise RuntimeError(f"{otherwise} for {_WATCHDOG_S:g} s; logs: {self._last_words()}")
            time.sleep(0.05)

    def _last_words(self) -> list[str]:
        logs = sorted(self._folder.glob("*.log"))
        return [f"{log.stem}: {log.read_text(errors='replace')[-300:]}" for log in logs]

    def _url(self, site: str) -> str:
        return f"redis://{ADDRESSES[site]}:{_PORT}/0"

    def _serve(self, stack: ExitStack, server: str, site: str) -> None:
        door = self._folder / f"{site}.sock"
        command = [
            server, "--bind", ADDRESSES[site], "--port", str(_PORT), "--protected-mode", "no", "--save", "",
            "--dir", str(self._folder), "--logfile", str(self._log(f"{site}-valkey")), "--unixsocket", str(door),
            "--client-output-buffer-limit", "pubsub", *SUBSCRIBER_LIMIT,
        ]  # fmt: skip
        stack.callback(end_program, self.link.start(site, command, self._log(f"{site}-server")))
        self._until(lambda: _answers(door), f"the server of {site} does not answer")
        folder = self._folder / f"{site}-coordinator"
        places = ("--updates", self._url(site), "--archive", f"sqlite://{folder}.db")
        arguments = (*places, "--directory", str(folder))
        coordinator = self._program(folder.name, site, "coordinator.service", *arguments)
        stack.callback(coordinator.end)

    def _start_bridge(self) -> SiteProgram:
        credentials = {}
        for site in ADDRESSES:
            credentials[site] = self._folder / f"{site}.json"
            write_private_json(credentials[site], {"updates": self._url(site)})
        allowed = []
        for name, (writer, _) in DIRECTIONS.items():
            for key in (RELIABLE, BEST_EFFORT):
                allowed += [f"--{name.replace('_', '-')}", key.format(writer)]
        places = ["--near", str(credentials["near"]), "--far", str(credentials["far"])]
        return self._program("bridge", "near", "sdnator.cli.main", "bridge", *places, *allowed)

    def _end_bridge(self) -> None:
        self._bridge.end()

    def _start_app(self, stack: ExitStack, site: str) -> SiteProgram:
        folder = self._folder / f"{site}-app"
        details = (site, self._url(site), str(folder), str(ITEM_BYTES))
        app = self._program(f"{site}-app", site, "benchmarks.cluster_bridge_app", *details)
        stack.callback(app.end)
        self._until(lambda: bool(app.progress), f"the app of {site} says nothing")
        return app

    def _program(self, name: str, site: str, module: str, *arguments: str) -> SiteProgram:
        log = self._log(name)
        program = SiteProgram(self.link.start(site, [sys.executable, "-m", module, *arguments], log), log)
        try:
            program.answer()
        except RuntimeError:
            program.end()
            raise
        return program

    def _log(self, name: str) -> Path:
        return self._folder / f"{name}.log"


def _sums(writer: Line, reader: Line) -> Line:
    return {
        "written": writer["written"],
        "unwanted": writer["unwanted"],
        "gaps": reader["gaps"],
        "got": reader["got"],
    }


def _answers(door: Path) -> bool:
    try:
        wire = Wire(f"unix://{door}")
    except UpdatesUnavailable:
        return False
    wire.close()
    return True
