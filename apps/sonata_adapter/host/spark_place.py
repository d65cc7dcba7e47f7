"""Where Spark runs, and its session there.  Does I/O."""

import logging
import os
import socket
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from apps.sonata_adapter.host.spark import SparkMissing, require_spark
from due.errors import InvalidOption

MASTER: Final = "spark://"
"""Begin of the address of a cluster's master."""
_ARROW_ROWS: Final = 16
"""Records, or windows of a shard, that a worker holds at a time; each may have megabytes."""
_QUIET: Final = {
    "spark.ui.enabled": "false",
    "spark.ui.showConsoleProgress": "false",
    "spark.sql.session.timeZone": "UTC",
    "spark.sql.execution.arrow.maxRecordsPerBatch": str(_ARROW_ROWS),
    # each costs a hundred calls into the JVM, and is looked at three times a second
    "spark.sql.streaming.numRecentProgressUpdates": "8",
}


@dataclass(frozen=True, kw_only=True)
class SparkPlace:
    """Where Spark runs, and what it is given."""

    master: str = "local[2]"
    """As Spark writes it: `local[2]`, `spark://host:7077`."""
    driver_host: str = "127.0.0.1"
    """Name or address at which the workers reach this machine."""
    jars: Sequence[Path] = ()
    python: str = sys.executable
    """On the workers."""
    options: Mapping[str, str] = field(default_factory=dict)
    """Further options of Spark."""


def way_to(master: str) -> str:
    """Our address on the way to Spark's master; sends nothing.  Raises `InvalidOption`."""
    if not master.startswith(MASTER):
        return "127.0.0.1"
    host, _, port = master.removeprefix(MASTER).partition(",")[0].rpartition(":")
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((host, int(port)))
            return str(probe.getsockname()[0])
    except (OSError, ValueError):
        raise InvalidOption(f"spark_master {master}: write spark://HOST:PORT") from None


def cluster_session(place: SparkPlace) -> Any:
    """Spark's session of this process, made for `place`; raises `SparkMissing`."""
    require_spark()
    if find_spec("pyarrow") is None or find_spec("pandas") is None:
        raise SparkMissing(
            "Spark's Arrow functions need pyarrow and pandas: pip install 'sdnator[arrow,spark]'"
        )
    from pyspark.errors import PySparkException
    from pyspark.sql import SparkSession

    os.environ.setdefault("PYSPARK_PYTHON", place.python)
    os.environ.setdefault("SPARK_LOCAL_HOSTNAME", place.driver_host)
    options = {
        **_QUIET,
        "spark.driver.host": place.driver_host,
        "spark.driver.bindAddress": place.driver_host,
        "spark.jars": ",".join(map(str, place.jars)),
        **place.options,
    }
    builder = SparkSession.builder.master(place.master).appName("sdnator sonata_spark")
    for name, value in options.items():
        builder = builder.config(name, value)
    try:
        session = builder.getOrCreate()
    except (PySparkException, OSError) as error:
        raise SparkMissing(
            f"Spark does not start on {place.master}: {error}; check the address of the master and Java"
        ) from None
    logging.getLogger("py4j").setLevel(logging.WARNING)
    return session
