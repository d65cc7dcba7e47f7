"""A Spark standalone cluster on loopback, from pyspark's own jars: a master, and workers that share no folder.

As root each worker is a machine in small: it has a /tmp of its own and its own process numbers, so that what one
writes no other sees, and all of it ends at once.
"""

import json
import os
import shutil
import signal
import subprocess
import time
import urllib.error
import urllib.request
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from apps.sonata_adapter.host.spark_jars import spark_home
from sdnator.errors import PipelineError
from sdnator.testing.ports import free_port

QUICK_JVM = "-XX:+UseSerialGC -XX:TieredStopAtLevel=1"
"""Options of a JVM that starts quickly and stays small."""
_START_S = 180.0
_STOP_S = 20.0
_ALONE = ("unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc")


class SparkCluster:
    """Between enter and exit there are a master and its workers.

    Args:
        folder: for logs.
        workers: how many, each with one core.
        memory: of the executor on each worker.
    """

    def __init__(self, folder: Path, workers: int = 2, memory: str = "512m") -> None:
        self._folder = folder
        self._number = workers
        self.memory = memory
        self._port, self._web = free_port(), free_port()
        self._master: subprocess.Popen[bytes] | None = None
        self._workers: dict[int, subprocess.Popen[bytes]] = {}

    @property
    def url(self) -> str:
        """For `spark_master`."""
        return f"spark://127.0.0.1:{self._port}"

    @property
    def options(self) -> dict[str, str]:
        """Options of a session that keeps its JVMs small."""
        return {
            "spark.executor.memory": self.memory,
            "spark.driver.memory": "512m",
            "spark.executor.extraJavaOptions": QUICK_JVM,
            "spark.driver.extraJavaOptions": QUICK_JVM,
            "spark.sql.shuffle.partitions": str(self._number),
        }

    def __enter__(self) -> Self:
        self._folder.mkdir(parents=True, exist_ok=True)
        try:
            command = ["Master", "--host", "127.0.0.1"]
            command += ["--port", str(self._port), "--webui-port", str(self._web)]
            self._master = self._spawn("master", [], command)
            self._wait(0)
            for number in range(self._number):
                self.start_worker(number)
            self._wait(self._number)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def start_worker(self, number: int) -> None:
        """Start a worker; returns at once."""
        # Spark takes executors of one address for processes of one machine, which read each other's files
        command = ["Worker", "--host", f"127.0.0.{2 + number}", "--webui-port", "0"]
        command += ["--cores", "1", "--memory", "1g"]
        alone = os.geteuid() == 0 and shutil.which("unshare") is not None
        place = Path("/tmp/work") if alone else self._folder / f"work{number}"  # noqa: S108 - its own /tmp
        before = [*_ALONE, "sh", "-c", 'mount -t tmpfs tmpfs /tmp && exec "$@"', "sh"] if alone else []
        self._workers[number] = self._spawn(
            f"worker{number}", before, [*command, "--work-dir", str(place), self.url]
        )

    def kill_worker(self, number: int) -> None:
        """kill -9 of a worker and all that it has started."""
        process = self._workers.pop(number)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def alive(self) -> int:
        """Workers that the master knows to be alive."""
        told = self._asked()
        return sum(worker["state"] == "ALIVE" for worker in told["workers"]) if told else 0

    def close(self) -> None:
        """End all."""
        for number in list(self._workers):
            self.kill_worker(number)
        if self._master is not None:
            self._master.terminate()
            try:
                self._master.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                self._master.kill()
                self._master.wait()
            self._master = None

    def _spawn(self, name: str, before: list[str], command: list[str]) -> subprocess.Popen[bytes]:
        home = spark_home()
        program = f"org.apache.spark.deploy.{command[0].lower()}.{command[0]}"
        with (self._folder / f"{name}.log").open("ab") as log:
            return subprocess.Popen(
                [*before, str(home / "bin" / "spark-class"), program, *command[1:]],
                env={
                    **os.environ,
                    "SPARK_HOME": str(home),
                    "SPARK_DAEMON_MEMORY": "256m",
                    "SPARK_DAEMON_JAVA_OPTS": QUICK_JVM,
                    "SPARK_LOCAL_HOSTNAME": command[2],
                },
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def _asked(self) -> dict[str, Any] | None:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self._web}/json/", timeout=5) as answer:
                told: dict[str, Any] = json.load(answer)
                return told
        except (OSError, urllib.error.URLError, ValueError):
            return None

    def _wait(self, workers: int) -> None:
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline:
            if self._asked() is not None and self.alive() >= workers:
                return
            time.sleep(0.2)
        said = [file.read_text(errors="replace")[-500:] for file in sorted(self._folder.glob("*.log"))]
        raise PipelineError(f"the Spark cluster did not start: {said}")
