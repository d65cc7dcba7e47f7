"""`sdnator archive export`: archived columns as Parquet.  The work is in `sdnator.archive_export`."""

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sdnator.cli.due_commands import Archive
from sdnator.errors import BadInput, PipelineError
from sdnator.notation import period_ns, typed_key
from sdnator.plurals import counted
from sdnator.redaction import redacted

if TYPE_CHECKING:
    from due.drivers.base import ArchiveDriver
    from sdnator.archive_export.export import ExportRequest
    from sdnator.archive_export.export_folder import ExportedHour, ExportFolder

archive_app = typer.Typer(help="Data Archives: export to Parquet.", no_args_is_help=True)

_PACKETS = "network.packets.p4runtime_ctrl.*.all"
_LINE_EVERY_S = 10.0


@archive_app.callback()
def _root() -> None:
    pass


@archive_app.command("export")
def export_archive(
    *,
    parquet: Annotated[
        Path,
        typer.Option(help="Folder to export into: a new one, or one of an earlier export.", metavar="DIR"),
    ],
    since: Annotated[
        str, typer.Option(help="Start: 1h or 7d ago, or a local time such as 2024-05-01T12:00.")
    ] = "1d",
    until: Annotated[str, typer.Option(help="End, like --since.", show_default="now")] = "",
    key: Annotated[
        str, typer.Option(help="Keys whose columns are exported; * matches one segment.", metavar="PATTERN")
    ] = _PACKETS,
    only_missing: Annotated[
        bool, typer.Option("--only-missing", help="Leave out hours that the folder holds whole already.")
    ] = False,
    archive: Archive = "",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Export archived columns, such as packets, to Parquet files: a folder for each hour of event time.

    Whole hours are exported, also the one in which --since lies. Exporting an hour again replaces its files. After an
    interruption --only-missing goes on where it ended.

    Exit codes: 0 done, 1 archive or folder failed, 2 bad input or misuse, 130 interrupted.

    Example: sdnator archive export --parquet day --since 24h
    """
    from sdnator.archive_export.export import ExportRequest
    from sdnator.up import running

    begin, end = period_ns(since, until)
    request = ExportRequest(begin=begin, end=end, key=typed_key(key), only_missing=only_missing)
    hours, kept = export_to(parquet, running.archive_url(archive), request)
    told = _told(parquet, request, hours, kept)
    if as_json:
        print(json.dumps(told))
    else:
        _show(told)
    _warn(told)


def export_to(parquet: Path, url: str, request: "ExportRequest") -> "tuple[list[ExportedHour], int]":
    """Export from an archive into a folder, with progress on standard error.

    Returns:
        The hours of the request in the folder, and how many of them were there before.

    Raises:
        BadInput: pyarrow is missing, or archive, key or folder cannot be used.
        PipelineError: archive or folder failed.
    """
    from due.errors import DueError, InvalidKey, InvalidOption, InvalidQuery
    from sdnator.archive_export.export import MOST_HOURS
    from sdnator.archive_export.export_folder import opened
    from sdnator.archive_export.hour_files import arrow
    from sdnator.northbound import open_existing

    arrow()
    if len(request.hours()) > MOST_HOURS:
        raise BadInput(f"{len(request.hours()):,} hours; export at most {MOST_HOURS:,} at once")
    try:
        with closing(open_existing(url)) as driver, opened(parquet, redacted(url), request.key) as folder:
            return _exported(driver, folder, request)
    except (InvalidKey, InvalidOption, InvalidQuery) as error:
        raise BadInput(str(error)) from None
    except DueError as error:
        raise PipelineError(f"{error}; what was exported before is kept: go on with --only-missing") from None


def _exported(
    driver: "ArchiveDriver", folder: "ExportFolder", request: "ExportRequest"
) -> "tuple[list[ExportedHour], int]":
    from sdnator.archive_export.export import export

    with _progress() as tell:
        return export(driver, folder, request, tell)


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int, int], None]]:
    """A bar on a terminal; elsewhere a line now and then."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

    from sdnator.cli.late_progress import LateProgress

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    with LateProgress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("export")
        last = time.monotonic()

        def tell(hour: str, done: int, hours: int, rows: int) -> None:
            nonlocal last
            text = f"{hour} UTC, {counted(rows, 'row')}"
            bar.update(task, description=text, completed=done, total=hours)
            if not console.is_terminal and time.monotonic() - last >= _LINE_EVERY_S:
                last = time.monotonic()
                print(
                    f"sdnator: export: {text}, {done:,} of {counted(hours, 'hour')}",
                    file=sys.stderr,
                    flush=True,
                )

        yield tell


def _told(parquet: Path, request: "ExportRequest", hours: "list[ExportedHour]", kept: int) -> dict[str, Any]:
    return {
        "folder": str(parquet),
        "key": request.key,
        "hours": len(hours),
        "kept": kept,
        "incomplete": sum(not hour.whole for hour in hours),
        "items": sum(hour.items for hour in hours),
        "rows": sum(hour.rows for hour in hours),
        "files": sum(len(hour.files) for hour in hours),
        "bytes": sum(hour.bytes for hour in hours),
        "refused": sum(hour.refused for hour in hours),
        "damaged": sum(hour.damaged for hour in hours),
    }


def _show(told: dict[str, Any]) -> None:
    kept = f", {told['kept']:,} of them from before" if told["kept"] else ""
    print(
        f"{told['folder']}: {counted(told['rows'], 'row')} of {counted(told['items'], 'item')} in "
        f"{counted(told['files'], 'file')}, {told['bytes']:,} bytes; {counted(told['hours'], 'hour')}{kept}"
    )


def _warn(told: dict[str, Any]) -> None:
    """What is not in the files."""
    notes = []
    if not told["rows"]:
        notes.append(
            f"no columns under {told['key']} in that time; they are archived while somebody observes them"
        )
    if told["refused"]:
        notes.append(f"{counted(told['refused'], 'item')} left out: no columns, or other ones than the rest")
    if told["damaged"]:
        notes.append(f"the archive could not read {counted(told['damaged'], 'row')}")
    if told["incomplete"]:
        notes.append("the current hour is not over: export it again later")
    for note in notes:
        print(f"sdnator: {note}", file=sys.stderr)
