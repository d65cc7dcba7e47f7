"""The jars that Spark needs for Kafka, copied by Maven into a cache folder.  Does I/O."""

import fcntl
import logging
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from apps.sonata_adapter.host.spark import SparkMissing, require_spark

_LOG = logging.getLogger(__name__)
_COPY_SECONDS: Final = 600
_COMPLETE: Final = "complete"
_ARTIFACT: Final = "spark-sql-kafka-0-10_2.13"
_NEXT_BEST: Final = "4.2.0"
"""Taken where there is none of pyspark's version; works with pyspark 4.3.0."""
_POM: Final = """<project xmlns="http://maven.apache.org/POM/4.0.0">
  <modelVersion>4.0.0</modelVersion>
  <groupId>org.sdnator</groupId><artifactId>{artifact}-with-dependencies</artifactId><version>1</version>
  <dependencies><dependency>
    <groupId>{group}</groupId><artifactId>{artifact}</artifactId><version>{version}</version>
  </dependency></dependencies>
</project>
"""


def kafka_connector_jars(folder: str = "") -> list[Path]:
    """The jars of Spark's source for Kafka, without those that pyspark brings.

    Args:
        folder: that holds them; empty: Maven copies those of pyspark's version once, into `$XDG_CACHE_HOME`, or others
            that are known to work.

    Raises:
        SparkMissing: pyspark, Java or Maven is missing, or there are no jars.
    """
    require_spark()
    import pyspark

    place = Path(folder) if folder else _copied((pyspark.__version__, _NEXT_BEST))
    # of any version: two of one library would be no less than one too many
    brought = {_artifact(jar) for jar in (spark_home() / "jars").glob("*.jar")}
    found = sorted(jar for jar in place.glob("*.jar") if _artifact(jar) not in brought)
    if not any(jar.name.startswith("spark-sql-kafka-0-10_") for jar in found):
        raise SparkMissing(
            f"{place}: no spark-sql-kafka-0-10_2.13-{pyspark.__version__}.jar, which reads Kafka for Spark"
        )
    return found


def _copied(versions: Sequence[str]) -> Path:
    """The jars of the first of these versions that are there, or that Maven gets."""
    here = [version for version in versions if (_cache(_ARTIFACT, version) / _COMPLETE).exists()]
    for version in here or versions[:-1]:
        try:
            return maven_jars("org.apache.spark", _ARTIFACT, version)
        except SparkMissing as error:
            _LOG.info("%s; trying %s", error, versions[-1])
    return maven_jars("org.apache.spark", _ARTIFACT, versions[-1])


def _artifact(jar: Path) -> str:
    """A jar's name without its version."""
    return jar.stem.rpartition("-")[0]


def spark_home() -> Path:
    """The folder of pyspark, which is a whole Spark."""
    import pyspark

    return Path(pyspark.__file__).parent


def maven_jars(group: str, artifact: str, version: str) -> Path:
    """The folder with an artifact's jar and those that it needs; Maven copies them once.

    Raises:
        SparkMissing: Maven is not installed, or does not get them.
    """
    folder = _cache(artifact, version)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # two processes copy once
        if not (folder / _COMPLETE).exists():
            _copy(folder, _POM.format(group=group, artifact=artifact, version=version), artifact)
            (folder / _COMPLETE).touch()
    return folder / "libs"


def _cache(artifact: str, version: str) -> Path:
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "sdnator" / f"{artifact}-{version}"


def _copy(folder: Path, pom: str, artifact: str) -> None:
    maven = shutil.which("mvn")
    if maven is None:
        raise SparkMissing(
            f"Maven copies the jars of {artifact} (on Debian: maven); or give a folder with them"
        )
    (folder / "pom.xml").write_text(pom, encoding="utf-8")
    copied = subprocess.run(
        [
            maven,
            "--quiet",
            "--batch-mode",
            "dependency:copy-dependencies",
            "-DincludeScope=runtime",
            f"-DoutputDirectory={folder / 'libs'}",
        ],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=_COPY_SECONDS,
        check=False,
    )
    if copied.returncode != 0:
        raise SparkMissing(
            f"Maven could not copy the jars of {artifact}: {(copied.stdout + copied.stderr)[-500:]}"
        )
