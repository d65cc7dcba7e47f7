"""The jars that Spark needs for Kafka, copied by Maven.  Does I/O."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from apps.sonata_adapter.host.maven_jars import MavenMissing, have_jars, maven_jars
from apps.sonata_adapter.host.spark import SparkMissing, require_spark

_LOG = logging.getLogger(__name__)
_ARTIFACT: Final = "spark-sql-kafka-0-10_2.13"
_NEXT_BEST: Final = "4.2.0"
"""Taken where there is none of pyspark's version; works with pyspark 4.3.0."""


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
            f"{place}: no spark-sql-kafka-0-10_2.13-{pyspark.__version__}.jar, which reads Kafka for Spark; "
            "copy it there, or give another folder of jars"
        )
    return found


def _copied(versions: Sequence[str]) -> Path:
    """The jars of the first of these versions that are there, or that Maven gets."""
    here = [version for version in versions if have_jars(_ARTIFACT, version)]
    for version in here or versions[:-1]:
        try:
            return maven_jars("org.apache.spark", _ARTIFACT, version)
        except MavenMissing as error:
            _LOG.info("%s; trying %s", error, versions[-1])
    try:
        return maven_jars("org.apache.spark", _ARTIFACT, versions[-1])
    except MavenMissing as error:
        raise SparkMissing(str(error)) from None


def _artifact(jar: Path) -> str:
    """A jar's name without its version."""
    return jar.stem.rpartition("-")[0]


def spark_home() -> Path:
    """The folder of pyspark, which is a whole Spark."""
    import pyspark

    return Path(pyspark.__file__).parent
