"""Programs as processes whose JSON lines are read while they run; all are killed at the end."""

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_wire import Wire

WATCHDOG_S = 120.0
Line = dict[str, Any]
T = TypeVar("T")


class ChildProgram:
    """A started program and what it has said."""

    def __init__(self, output: Path, *arguments: object, module: str = "benchmarks.faults_programs") -> None:
        self._output = output
        command = [sys.executable, "-m", module, *map(str, arguments)]
        with output.open("wb") as out:
            self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=out)

    def lines(self) -> list[Line]:
        """All whole lines so far."""
        text = self._output.read_text().rpartition("\n")[0]
        return [json.loads(line) for line in text.splitlines()]

    def wait(self, condition: Callable[[Line], bool]) -> Line:
        """The first line that meets the condition; raises RuntimeError after two minutes."""
        return until(lambda: next((line for line in self.lines() if condition(line)), None))

    def finish(self) -> Line:
        """Ask it to end; its last line."""
        self.tell()
        self.process.wait(WATCHDOG_S)
        return self.lines()[-1]

    def tell(self) -> None:
        """Send a line."""
        assert self.process.stdin is not None
        self.process.stdin.write(b"\n")
        self.process.stdin.flush()

    def kill(self) -> float:
        """kill -9; returns when."""
        at = time.monotonic()
        self.process.kill()
        self.process.wait()
        if self.process.stdin is not None:
            self.process.stdin.close()
        return at


class FaultStage:
    """One Data Updates server and the programs that use it; a context manager."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._stack = ExitStack()
        self._programs: list[ChildProgram] = []
        self.server = EmbeddedServer(folder / "updates")

    def __enter__(self) -> Self:
        self._stack.enter_context(self.server)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for program in self._programs:
            program.kill()
        self._stack.close()

    def start(self, name: str, *arguments: object) -> ChildProgram:
        """Start one of `benchmarks.faults_programs`."""
        return self._started(name, self.server.url, *arguments)

    def coordinator(self) -> ChildProgram:
        """Start a Coordinator and wait until it is ready; `.wait` finds its ready line with the API's URL."""
        archive = f"sqlite://{self.folder / 'archive.db'}"
        options = ("--updates", self.server.url, "--archive", archive, "--log", "warning")
        program = self._started(*options, module="coordinator.service")
        program.wait(lambda line: bool(line.get("ready")))
        return program

    def used_memory(self) -> int:
        """Bytes that the server holds."""
        wire = Wire(self.server.url)
        info = wire.call("INFO", "memory").decode()
        wire.close()
        return int(next(x for x in info.splitlines() if x.startswith("used_memory:")).split(":")[1])

    def _started(self, *arguments: object, **options: Any) -> ChildProgram:
        output = self.folder / f"program{len(self._programs)}.jsonl"
        self._programs.append(ChildProgram(output, *arguments, **options))
        return self._programs[-1]


class ArchiveServer:
    """nx-27017, which speaks MongoDB's protocol over a file; raises LookupError where it is not installed."""

    def __init__(self, folder: Path) -> None:
        self._program = Path(sys.executable).with_name("nx-27017")
        if not self._program.exists():
            raise LookupError("nx-27017 is not installed: pip install nx-27017")
        self._folder = folder
        self._port = 0
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> str:
        """Start, on the same port as before; returns the archive's URL when it listens."""
        files = {name: str(self._folder / f"nx.{name}") for name in ("db", "pid", "log")}
        Path(files["log"]).unlink(missing_ok=True)
        options = ["--db", files["db"], "--pid-file", files["pid"], "--log-file", files["log"]]
        self._process = subprocess.Popen(
            [str(self._program), "--port", str(self._port), *options],
            cwd=self._folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._port = until(lambda: _port_in(Path(files["log"])))
        return f"mongodb://127.0.0.1:{self._port}/faults?serverSelectionTimeoutMS=500"

    def stop(self) -> None:
        """End it; may be called twice."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait(30)


def _port_in(log: Path) -> int | None:
    found = re.search(r"Listening on 127\.0\.0\.1:(\d+)", log.read_text() if log.exists() else "")
    return int(found[1]) if found else None


def until(condition: Callable[[], T | None]) -> T:
    """The first true answer; raises RuntimeError after two minutes."""
    deadline = time.monotonic() + WATCHDOG_S
    while time.monotonic() < deadline:
        answer = condition()
        if answer:
            return answer
        time.sleep(0.02)
    raise RuntimeError(f"nothing happened within {WATCHDOG_S:g} s")
