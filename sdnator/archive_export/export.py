"""Exports a period of the archive, hour by hour.  Does I/O."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from apps.messages import MessageError
from apps.sonata_adapter.host.archive_columns import first_row
from due import Item
from due.drivers.base import ArchiveDriver
from sdnator.archive_export.archive_items import archived_items
from sdnator.archive_export.export_folder import ExportedHour, ExportFolder, name_of
from sdnator.archive_export.hour_files import HourFiles
from sdnator.archive_export.item_rows import rows_of

PACKETS: Final = "network.packets.p4runtime_ctrl.*.all"
"""What is exported by default: every packet that the switches copied for somebody."""
HOUR_NS: Final = 3_600 * 10**9
MOST_HOURS: Final = 100_000
"""Most hours of one export: eleven years."""
_MOST_KEYS: Final = 10_000
_TELL_ROWS: Final = 100_000

Tell = Callable[[str, int, int, int], None]
"""Is told the hour, how many are done, how many there are, and the rows so far."""


@dataclass(frozen=True, kw_only=True)
class ExportRequest:
    """What is to be in the folder."""

    begin: int
    """What was written from then on, ns."""
    end: int
    """What was written before, ns."""
    key: str = PACKETS
    whole_hours: bool = True
    """All of the hours that the period touches; otherwise nothing outside of it."""
    only_missing: bool = False
    """Leave out hours that the folder holds whole."""

    def hours(self) -> range:
        """The hours that it touches, since the epoch."""
        return range(self.begin // HOUR_NS, -(-self.end // HOUR_NS))


def export(
    archive: ArchiveDriver, folder: ExportFolder, request: ExportRequest, tell: Tell
) -> tuple[list[ExportedHour], int]:
    """Bring the hours of a request into the folder.

    Args:
        archive: read in pieces.
        folder: where those hours are replaced.
        request: which ones.
        tell: called several times an hour.

    Returns:
        All hours of the request as they are in the folder now, and how many of them were there before.

    Raises:
        BackendError: the archive failed; hours before that are in the folder.
        OSError: the folder cannot be written; the same.
    """
    found: list[ExportedHour] = []
    kept = rows = 0
    hours = request.hours()
    for number, hour in enumerate(hours):
        known = folder.hour(hour) if request.only_missing else None
        if known is not None and known.whole:
            kept += 1
        else:
            progress = partial(_tell_rows, tell, hour, number, len(hours), rows)
            known = _exported(archive, folder, _asked(request, hour), progress)
        rows += known.rows
        found.append(known)
        tell(name_of(hour), number + 1, len(hours), rows)
    return found, kept


def _tell_rows(tell: Tell, hour: int, done: int, hours: int, before: int, rows: int) -> None:
    tell(name_of(hour), done, hours, before + rows)


def _asked(request: ExportRequest, hour: int) -> ExportedHour:
    begin, end = hour * HOUR_NS, (hour + 1) * HOUR_NS
    if not request.whole_hours:
        begin, end = max(begin, request.begin), min(end, request.end)
    # an hour that has not ended gets more
    whole = request.whole_hours and end <= time.time_ns()
    return ExportedHour(hour=hour, begin=begin, end=end, whole=whole)


def _exported(
    archive: ArchiveDriver, folder: ExportFolder, hour: ExportedHour, tell: Callable[[int], None]
) -> ExportedHour:
    files = HourFiles(folder.new, name_of(hour.hour), folder.about.columns)
    damaged = archive.damaged
    keys: set[str] = set()
    try:
        told = 0
        for item in archived_items(archive, folder.about.key, hour.begin, hour.end):
            _take(files, item, hour, keys)
            if hour.rows - told >= _TELL_ROWS:
                told = hour.rows
                tell(told)
        written = files.close()
    except BaseException:
        files.abandon()
        raise
    hour.keys, hour.damaged = sorted(keys), archive.damaged - damaged
    folder.replace(hour, written, files.columns)
    return hour


def _take(files: HourFiles, item: Item, hour: ExportedHour, keys: set[str]) -> None:
    if item.key not in keys and len(keys) >= _MOST_KEYS:
        hour.refused += 1
        return
    try:
        rows = rows_of(item, first_row(hour.hour) + hour.rows)
        if len(rows):
            files.add(item.key, rows)
    except MessageError:
        hour.refused += 1
        return
    keys.add(item.key)
    hour.items += 1
    hour.rows += len(rows)


def exported_files(folder: Path, hours: list[ExportedHour]) -> Iterator[Path]:
    """Where the files of these hours are."""
    return (folder.absolute() / name for hour in hours for name in hour.files)
