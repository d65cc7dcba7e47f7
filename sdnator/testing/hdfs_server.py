"""A real HDFS on loopback, one process with a name node and a data node, from Hadoop's own jars.

It is what Spark's checkpoint is on: a place that driver and workers reach by the network alone.
"""

import json
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Self

from apps.sonata_adapter.host.maven_jars import MavenMissing, maven_jars
from apps.sonata_adapter.host.spark import SparkMissing
from sdnator.errors import PipelineError
from sdnator.testing.ports import free_port
from sdnator.testing.spark_cluster import QUICK_JVM

HADOOP_VERSION = "3.5.0"
_JUNIT_VERSION = "5.11.4"
_START_S = 180.0
_STOP_S = 20.0
_PROGRAM = "org.apache.hadoop.test.MiniDFSClusterManager"


class HdfsServer:
    """Between enter and exit there is an empty HDFS.

    Args:
        folder: for its data and log.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._port = free_port()
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        """Begins the addresses of its folders."""
        return f"hdfs://127.0.0.1:{self._port}"

    def __enter__(self) -> Self:
        self._folder.mkdir(parents=True, exist_ok=True)
        details = self._folder / "details.json"
        command = ["java", "-Xmx256m", *QUICK_JVM.split(), f"-Dtest.build.data={self._folder / 'data'}"]
        command += ["-cp", ":".join(map(str, _jars())), _PROGRAM, "-format", "-datanodes", "1"]
        command += ["-nnport", str(self._port), "-writeDetails", str(details)]
        command += ["-D", "dfs.permissions.enabled=false"]
        with (self._folder / "hdfs.log").open("ab") as log:
            self._process = subprocess.Popen(
                command,
                cwd=self._folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline and self._process.poll() is None:
            if details.exists() and _whole(details):
                return self
            time.sleep(0.2)
        self._stop()
        said = (self._folder / "hdfs.log").read_text(errors="replace")[-2000:]
        raise PipelineError(f"HDFS did not start: {said}")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    def _stop(self) -> None:
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process = None


def _jars() -> list[Path]:
    """Hadoop's servers with what they need."""
    try:
        servers = maven_jars("org.apache.hadoop", "hadoop-client-minicluster", HADOOP_VERSION)
        # the program comes from Hadoop's own tests
        asserting = maven_jars("org.junit.jupiter", "junit-jupiter-api", _JUNIT_VERSION)
    except MavenMissing as error:
        raise SparkMissing(str(error)) from None
    return [*sorted(servers.glob("*.jar")), *sorted(asserting.glob("*.jar"))]


def _whole(details: Path) -> bool:
    try:
        return bool(json.loads(details.read_text()))
    except ValueError:
        return False
