"""A real primary with replicas and sentinels on loopback, out of the embedded server's wheel.

The servers keep nothing on disk: what a killed one had is with the others, or nowhere.
"""

import signal
import subprocess
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Self, cast

import redis
from redis.backoff import NoBackoff
from redis.retry import Retry

from due.drivers.embedded_redis import SUBSCRIBER_LIMIT, ending_with_us, server_program
from due.private_files import write_private
from sdnator.testing.ports import free_port

SERVICE = "due"
_START_SECONDS = 60.0
_QUORUM = 2
_DOWN_AFTER_MS = 1000
_FAILOVER_MS = 3000
"""A failed failover is tried again after twice this time."""


class SentinelsMissing(RuntimeError):
    """They did not start; the text has their last words."""


class SentinelServers:
    """One primary at first, its replicas, and sentinels that watch them.

    Args:
        folder: for settings and logs.
        replicas: how many.
        sentinels: how many; two must agree on a failover.
        to_write: a primary with fewer replicas than this takes no writes.
    """

    def __init__(self, folder: Path, replicas: int = 2, sentinels: int = 3, *, to_write: int = 0) -> None:
        self._folder = folder
        self._to_write = to_write
        self._ports = [free_port() for _ in range(1 + replicas)]
        self._sentinel_ports = [free_port() for _ in range(sentinels)]
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def url(self) -> str:
        """For `set_pubsub`."""
        places = ",".join(f"127.0.0.1:{port}" for port in self._sentinel_ports)
        return f"redis+sentinel://{places}/{SERVICE}"

    def port(self, number: int) -> int:
        """Of a server, on 127.0.0.1."""
        return self._ports[number]

    def start(self) -> Self:
        """Start all, and wait until every sentinel knows all the others.

        Raises:
            SentinelsMissing: one ended, or did not in time.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        for number in range(len(self._ports)):
            self.start_server(number, 0)
        replicas = len(self._ports) - 1
        self._until(lambda: self._told(self._ports[0], "INFO", "replication")["connected_slaves"] == replicas)
        for number, port in enumerate(self._sentinel_ports):
            self._start_sentinel(number, port)
        self._until(lambda: all(map(self._knows_all, self._sentinel_ports)))
        return self

    def start_server(self, number: int, primary: int | None = None) -> None:
        """Start one server, empty; as a replica unless `primary` is its own number.

        Args:
            number: which one.
            primary: whose replica it is; None: of today's primary.
        """
        follows = self.primary if primary is None else primary
        arguments: list[object] = [
            *("--port", self._ports[number], "--bind", "127.0.0.1", "--dir", self._home(f"server-{number}")),
            *("--save", "", "--appendonly", "no", "--repl-diskless-sync-delay", 0),
            *("--min-replicas-to-write", self._to_write),
            *("--client-output-buffer-limit", "pubsub", *SUBSCRIBER_LIMIT),
        ]
        if follows != number:
            arguments += ["--replicaof", "127.0.0.1", self._ports[follows]]
        self._run(f"server-{number}", arguments)

    @property
    def primary(self) -> int:
        """Number of the server that the sentinels call the primary.

        Raises:
            SentinelsMissing: they call none so for a minute.
        """
        found: list[int] = []

        def ask() -> bool:
            told = self._told(self._sentinel_ports[0], "SENTINEL", "GET-MASTER-ADDR-BY-NAME", SERVICE)
            found[:] = [self._ports.index(int(told[1]))]
            return True

        self._until(ask)
        return found[0]

    @property
    def replicas(self) -> list[int]:
        """Numbers of the servers that run, without the primary."""
        first = self.primary
        return [n for n in range(len(self._ports)) if n != first and f"server-{n}" in self._processes]

    def command(self, number: int, *words: object) -> Any:
        """What a server answers; raises redis.RedisError, OSError."""
        return self._told(self._ports[number], *words)

    def empty(self) -> None:
        """Delete everything."""
        self.command(self.primary, "FLUSHALL")

    def kill(self, number: int) -> None:
        """kill -9 of one server."""
        process = self._processes.pop(f"server-{number}")
        process.kill()
        process.wait()

    def freeze(self, numbers: Iterable[int], *, frozen: bool = True) -> None:
        """Stop servers as a hung machine would, or let them go on."""
        for number in numbers:
            self._processes[f"server-{number}"].send_signal(signal.SIGSTOP if frozen else signal.SIGCONT)

    def cut_off(self, numbers: Iterable[int]) -> None:
        """Let replicas copy nothing from now on; they keep what they have."""
        for number in numbers:
            self.command(number, "REPLICAOF", "127.0.0.1", free_port())

    def hand_over(self) -> None:
        """Let the sentinels make a replica the primary, though nothing is broken."""
        self._told(self._sentinel_ports[0], "SENTINEL", "FAILOVER", SERVICE)

    def wait_for_other(self, primary: int, seconds: float = _START_SECONDS) -> int:
        """The number of the primary, once it is another than this one."""
        deadline = time.monotonic() + seconds
        while (found := self.primary) == primary:
            if time.monotonic() > deadline:
                raise SentinelsMissing(f"no failover: {self._last_words()}")
            time.sleep(0.02)
        return found

    def stop(self) -> None:
        """End all; the folder stays."""
        for process in self._processes.values():
            process.kill()
        for process in self._processes.values():
            process.wait()
        self._processes.clear()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _start_sentinel(self, number: int, port: int) -> None:
        home = self._home(f"sentinel-{number}")
        settings = [
            f"port {port}",
            "bind 127.0.0.1",
            f"dir {home}",
            f"sentinel monitor {SERVICE} 127.0.0.1 {self._ports[0]} {_QUORUM}",
            f"sentinel down-after-milliseconds {SERVICE} {_DOWN_AFTER_MS}",
            f"sentinel failover-timeout {SERVICE} {_FAILOVER_MS}",
            f"sentinel parallel-syncs {SERVICE} {len(self._ports)}",
        ]
        path = home / "sentinel.conf"
        write_private(path, "\n".join(settings) + "\n")
        self._run(f"sentinel-{number}", [path, "--sentinel"])

    def _run(self, name: str, arguments: Iterable[object]) -> None:
        with (self._home(name) / "log").open("ab") as log:
            self._processes[name] = subprocess.Popen(
                ending_with_us([server_program(), *map(str, arguments)]),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=self._home(name),
            )

    def _home(self, name: str) -> Path:
        home = self._folder / name
        home.mkdir(parents=True, exist_ok=True)
        return home

    def _knows_all(self, port: int) -> bool:
        told = self._told(port, "SENTINEL", "MASTERS")
        about = {str(name): value for name, value in dict(told)[SERVICE].items()}
        others = len(self._sentinel_ports) - 1
        return (
            int(about["num-slaves"]) == len(self._ports) - 1 and int(about["num-other-sentinels"]) == others
        )

    def _told(self, port: int, *words: object) -> Any:
        once = Retry(NoBackoff(), 0)
        with redis.Redis("127.0.0.1", port, protocol=2, socket_timeout=5, retry=once) as one:
            name = " ".join(map(str, words[:2])) if words[0] == "SENTINEL" else str(words[0])
            rest = words[2:] if words[0] == "SENTINEL" else words[1:]
            return cast("Any", one).execute_command(name, *rest)

    def _until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + _START_SECONDS
        while time.monotonic() < deadline:
            if any(process.poll() is not None for process in self._processes.values()):
                break
            try:
                if condition():
                    return
            except (redis.RedisError, OSError, LookupError, ValueError, TypeError):
                pass  # not there yet
            time.sleep(0.05)
        said = self._last_words()
        self.stop()
        raise SentinelsMissing(f"the servers did not start: {said}")

    def _last_words(self) -> list[str]:
        logs = sorted(self._folder.glob("*/log"))
        return [f"{path.parent.name}: {path.read_text(errors='replace')[-300:]}" for path in logs]
