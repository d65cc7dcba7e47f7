"""The folder of an export: which hours of the archive it holds, and how one replaces another.  Does I/O.

    date=2024-05-01/hour=07/2024-05-01T07-000.parquet   by hour of event time; named by the hour of the archive
    _export/about.json                                  which archive, keys and columns
    _export/2024-05-01T07.json                          an hour of the archive: its files, and whether it is complete
    _new/                                               files that are being written

Readers pass over what begins with `_`.  An hour counts from the moment at which its JSON file says so; before that its
files come into their places one by one, each whole.
"""

import fcntl
import os
import re
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TypeVar

import msgspec

from due.private_files import write_private
from sdnator.archive_export.hour_files import WrittenFile
from sdnator.errors import BadInput, PipelineError

VERSION: Final = 1
"""Format of the folder; another one is refused."""
_ABOUT: Final = "about.json"
_PRIVATE: Final = 0o700
_MOST_BYTES: Final = 64 << 20
_PLACE: Final = re.compile(r"date=[-\d]+/hour=\d\d/[-\dT]+\.parquet", re.ASCII)
_T = TypeVar("_T")


class ExportAbout(msgspec.Struct, kw_only=True):
    """What a folder holds."""

    version: int
    archive: str
    """URL without user and password."""
    key: str
    columns: dict[str, str] = {}
    """Name to Arrow's type; empty before the first row."""


class ExportedHour(msgspec.Struct, kw_only=True):
    """An hour of the archive in the folder."""

    hour: int
    """Since the epoch, UTC."""
    begin: int
    """Only what was written from then on, ns."""
    end: int
    """Only what was written before, ns."""
    exported: int = 0
    """When that was, ns."""
    whole: bool = False
    """Whether its files hold all of the hour, so that nothing is missing."""
    files: list[str] = []
    """Below the folder."""
    keys: list[str] = []
    items: int = 0
    rows: int = 0
    bytes: int = 0
    refused: int = 0
    """Items that were left out because they are no columns, or other ones."""
    damaged: int = 0
    """Rows of the archive that it could not read."""


class ExportFolder:
    """One export; made by `opened`."""

    def __init__(self, path: Path, about: ExportAbout) -> None:
        self.path = path
        self.about = about
        self.new = path / "_new"
        self._state = path / "_export"

    def hour(self, hour: int) -> ExportedHour | None:
        """What the folder holds of an hour of the archive; None: nothing that counts."""
        found = _read(self._file(hour), ExportedHour)
        # what others may have written must not lead out of the folder
        if found is not None and not all(map(_PLACE.fullmatch, found.files)):
            raise BadInput(
                f"{self._file(hour)}: names files elsewhere; delete it, and export that hour again"
            )
        return found

    def replace(self, hour: ExportedHour, files: Sequence[WrittenFile], columns: Mapping[str, str]) -> None:
        """Put files in the place of those that the folder holds of this hour; raises OSError.

        Killed at any time, it leaves an hour that does not count, and no file that nobody knows.
        """
        before = self.hour(hour.hour)
        places = [file.place for file in files]
        if columns != self.about.columns:
            self.about.columns = dict(columns)
            self._write(self._state / _ABOUT, self.about)
        old = [] if before is None else before.files
        if old or places:
            known = sorted({*old, *places})
            self._note(msgspec.structs.replace(hour, whole=False, exported=0, files=known))
        for file in files:
            place = self.path / file.place
            place.parent.mkdir(mode=_PRIVATE, parents=True, exist_ok=True)
            file.path.replace(place)
        for name in set(old) - set(places):
            (self.path / name).unlink(missing_ok=True)
            self._remove_empty((self.path / name).parent)
        hour.files, hour.exported = places, time.time_ns()
        hour.bytes = sum((self.path / name).stat().st_size for name in places)
        self._note(hour)

    def _note(self, hour: ExportedHour) -> None:
        self._write(self._file(hour.hour), hour)

    def _write(self, path: Path, value: msgspec.Struct) -> None:
        write_private(path, msgspec.json.encode(value).decode() + "\n")

    def _file(self, hour: int) -> Path:
        return self._state / f"{name_of(hour)}.json"

    def _remove_empty(self, folder: Path) -> None:
        for each in (folder, folder.parent):
            if each != self.path and not any(each.iterdir()):
                each.rmdir()


@contextmanager
def opened(path: Path, archive: str, key: str) -> Iterator[ExportFolder]:
    """A folder to export into, made where there is none; nobody else may have it meanwhile.

    Args:
        path: of the folder.
        archive: URL without user and password.
        key: pattern of the keys.

    Raises:
        BadInput: it holds something else, or cannot be written.
        PipelineError: another export runs there, or it cannot be written any more.
    """
    with _os_errors(path):
        _check_foreign(path)
        state = path / "_export"
        state.mkdir(mode=_PRIVATE, parents=True, exist_ok=True)
        descriptor = os.open(state / "lock", os.O_WRONLY | os.O_CREAT, 0o600)
        with os.fdopen(descriptor, "wb") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise PipelineError(f"{path}: another export is writing there; wait for its end") from None
            folder = ExportFolder(path, _about(state / _ABOUT, archive, key))
            shutil.rmtree(folder.new, ignore_errors=True)  # of an export that was killed
            folder.new.mkdir(mode=_PRIVATE)
            try:
                yield folder
            finally:
                shutil.rmtree(folder.new, ignore_errors=True)


@contextmanager
def _os_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except PermissionError as error:
        raise BadInput(f"{path}: {error.strerror}; give a folder that you can write to") from None
    except (FileExistsError, NotADirectoryError):
        raise BadInput(f"{path}: is not a folder; give another name") from None
    except OSError as error:
        raise PipelineError(f"{path}: {error.strerror or error}; check free space and permissions") from None


def _check_foreign(path: Path) -> None:
    if path.is_dir() and not (path / "_export").is_dir() and any(path.iterdir()):
        raise BadInput(
            f"{path}: the folder holds other files; give an empty one, or one of an earlier export"
        )


def _about(file: Path, archive: str, key: str) -> ExportAbout:
    asked = ExportAbout(version=VERSION, archive=archive, key=key)
    found = _read(file, ExportAbout)
    if found is None:
        write_private(file, msgspec.json.encode(asked).decode() + "\n")
        return asked
    if found.version != VERSION:
        raise BadInput(f"{file}: format {found.version}, not {VERSION}; export into another folder")
    if (found.archive, found.key) != (archive, key):
        raise BadInput(
            f"{file.parent.parent}: holds {found.key} of {found.archive}, not {key} of {archive}; give another folder"
        )
    return found


def _read(file: Path, kind: type[_T]) -> _T | None:
    """The content of a JSON file; None: there is none."""
    try:
        with file.open("rb") as stream:
            return msgspec.json.decode(stream.read(_MOST_BYTES), type=kind)
    except FileNotFoundError:
        return None
    except (msgspec.MsgspecError, UnicodeError) as error:
        raise BadInput(f"{file}: damaged ({error}); export into another folder") from None


def name_of(hour: int) -> str:
    """An hour for people and file names: `2024-05-01T07`.

    Args:
        hour: since the epoch, UTC.
    """
    return time.strftime("%Y-%m-%dT%H", time.gmtime(hour * 3_600))
