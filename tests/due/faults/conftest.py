"""Programs as processes with their output in files, killed at the end whatever happens."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest

from due.drivers.embedded_redis import EmbeddedServer

ROOT = Path(__file__).parents[3]


class Program:
    """A started process with its output in a file."""

    def __init__(
        self,
        folder: Path,
        *arguments: object,
        module: str = "tests.due.faults.programs",
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.output = folder / f"output-{time.monotonic_ns()}.txt"
        command = [sys.executable, "-m", module, *map(str, arguments)]
        with self.output.open("wb") as out:
            self.process = subprocess.Popen(
                command,
                cwd=ROOT,
                stdin=subprocess.PIPE,
                stdout=out,
                env={**os.environ, **(environment or {})},
            )

    def lines(self) -> list[str]:
        """What was said so far, whole lines."""
        return self.output.read_text().rpartition("\n")[0].splitlines()

    def wait_for(self, text: str, seconds: float = 90.0) -> str:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            found = [line for line in self.lines() if line.startswith(text)]
            if found:
                return found[-1]
            assert self.process.poll() in (None, 0), "the program failed"
            time.sleep(0.02)
        raise AssertionError(f"{text!r} not seen; last lines {self.lines()[-3:]}")

    def numbers(self) -> list[int]:
        return [int(line.split()[1]) for line in self.lines() if line[:1].isdigit() and " " in line]

    def say(self) -> None:
        """Send a line."""
        assert self.process.stdin is not None
        self.process.stdin.write(b"\n")
        self.process.stdin.flush()

    def stop(self, number: int) -> None:
        """Send a signal."""
        self.process.send_signal(number)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        if self.process.stdin:
            self.process.stdin.close()


@pytest.fixture
def programs(tmp_path) -> Iterator[Callable[..., Program]]:
    started = []

    def start(*arguments, **options):
        started.append(Program(tmp_path, *arguments, **options))
        return started[-1]

    yield start
    for program in started:
        program.kill()


@pytest.fixture
def own_server(tmp_path) -> Iterator[EmbeddedServer]:
    with EmbeddedServer(tmp_path / "updates") as server:
        yield server


@pytest.fixture
def coordinator(programs, own_server, tmp_path) -> Callable[[], Program]:
    """Starts a real Coordinator on the server of the test."""

    def start() -> Program:
        archive = f"sqlite://{tmp_path / 'coordinator.db'}"
        program = programs("--updates", own_server.url, "--archive", archive, module="coordinator.service")
        program.wait_for('{"ready"')
        return program

    return start
