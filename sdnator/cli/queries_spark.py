"""Queries over archived packets on Spark: exported to Parquet, then read by its workers.

archive ─► `sdnator.archive_export` ─► Parquet ─► `apps.sonata_adapter.host.spark_archive` ─► results
"""

import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from apps.sonata_adapter.host.archive_columns import switch_of
from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.query.dataflow import TupleStream, compile_query
from sdnator.archive_export.export import ExportRequest, exported_files
from sdnator.cli.archive_commands import export_to
from sdnator.cli.queries_run import FoundInPast, Past, base_us, count_notes, loss_notes, over_archive
from sdnator.errors import BadInput
from sdnator.northbound import open_existing

if TYPE_CHECKING:
    from apps.sonata_adapter.host.spark_archive import ArchiveResults
    from sdnator.archive_export.export_folder import ExportedHour

_PATTERN: Final = re.compile(r"[*?\[\]{}\\]")
"""What Spark takes for a pattern in the name of a file."""


class SparkRun(NamedTuple):
    """Where Spark runs, and what it reads."""

    master: str
    options: Sequence[str]
    """NAME=VALUE."""
    parquet: Path | None
    """The folder of the export; None: a temporary one."""


def on_spark_over_archive(request: QueryRequest, period: Past, run: SparkRun) -> FoundInPast:
    """Run a query over archived packets on Spark; a raw stream goes through this process.

    Raises:
        BadInput: an option or the archive cannot be used.
        PipelineError: the export failed.
        SonataError: Spark is missing, or failed.
    """
    from apps.sonata_adapter.host.spark import require_spark

    if isinstance(compile_query(request.query), TupleStream):
        return over_archive(request, period, HostEngine)
    require_spark()
    _options(run)
    if run.parquet is None and not run.master.startswith("local"):
        raise BadInput(
            f"--master {run.master}: give --parquet a folder that all its machines have mounted at one path"
        )
    with _folder(run.parquet) as folder:
        if _PATTERN.search(str(folder)):
            raise BadInput(
                f"--parquet {folder}: Spark would read this name as a pattern; give one without * ? [ ] {{ }} and \\"
            )
        asked = ExportRequest(
            begin=period.begin, end=period.end, whole_hours=run.parquet is not None, only_missing=True
        )
        hours, _ = export_to(folder, period.url, asked)
        found = _run(request, period, run, exported_files(folder, hours), _bases(period.url, hours))
    losses = loss_notes(sum(hour.refused for hour in hours), sum(hour.damaged for hour in hours))
    return FoundInPast(outputs=found.results, notes=lambda: [count_notes(found.packets, found.late), losses])


def _run(
    request: QueryRequest, period: Past, run: SparkRun, files: Iterator[Path], bases: dict[str, int]
) -> "ArchiveResults":
    from apps.sonata_adapter.host.spark_archive import ArchivedPackets, run_archived
    from apps.sonata_adapter.host.spark_place import SparkPlace, cluster_session, way_to

    packets = ArchivedPackets(files=list(files), begin_ns=period.begin, end_ns=period.end, bases=bases)
    options = {"spark.ui.showConsoleProgress": str(sys.stderr.isatty()).lower(), **_options(run)}
    place = SparkPlace(master=run.master, driver_host=way_to(run.master), options=options)
    return run_archived(cluster_session(place), packets, request.query)


def _bases(url: str, hours: "list[ExportedHour]") -> dict[str, int]:
    """Clock zeros of all switches in these hours."""
    switches = sorted({switch_of(key) for hour in hours for key in hour.keys})
    with closing(open_existing(url)) as archive:
        return {switch: base_us(archive, switch) for switch in switches}


@contextmanager
def _folder(given: Path | None) -> Iterator[Path]:
    if given is not None:
        yield given.absolute()
        return
    with tempfile.TemporaryDirectory(prefix="sdnator-spark-") as made:
        yield Path(made) / "packets"


def _options(run: SparkRun) -> dict[str, str]:
    found = {}
    for text in run.options:
        name, equals, value = text.partition("=")
        if not equals or not name.startswith("spark."):
            raise BadInput(f"--spark-option {text}: write NAME=VALUE, such as spark.executor.memory=4g")
        found[name] = value
    return found
