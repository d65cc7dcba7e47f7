"""`sdnator backup` and `restore`: archive, configuration and trained models as one file.

    FILE (tar, gzip)   manifest.json, archive.db, sdnator.toml, models/…

The archive is copied as a consistent snapshot, also while a pipeline writes to it.
"""

import errno
import io
import json
import os
import shutil
import sqlite3
import tarfile
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote, unquote, urlsplit

import typer

from due.private_files import give_to_owner, private_folder
from sdnator import __version__
from sdnator.config import config_file
from sdnator.errors import BadInput, PipelineError
from sdnator.up import running

SCHEMA = 1
"""Format of the backup; a newer one is refused."""
_KEPT = "kept/kitsune.npz"
"""The model of the state folder."""
_MANIFEST, _ARCHIVE, _CONFIG, _MODELS = "manifest.json", "archive.db", "sdnator.toml", "models"
_PRIVATE = 0o600
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_WITH_IT = ("", "-wal", "-shm")
"""Endings of the files of a SQLite database; a database without its -wal lacks what was written last."""

Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


def backup(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Backup file to write; it must not exist.")],
    *,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Configuration; default: the one that `sdnator up` uses."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write archive, configuration and trained models into one file.

    The pipeline may be running. Back up a MongoDB archive with its own tools (mongodump).
    Exit codes: 0 written, 1 it could not be written, 2 misuse.

    Example: sdnator backup sdnator-backup.tar.gz
    """
    if file.exists():
        raise BadInput(f"{file} already exists: give another name")
    path = config or config_file.find()
    settings = config_file.load(path)
    with _own_files(path, settings) as parts:
        manifest = {
            "schema": SCHEMA,
            "version": __version__,
            "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "archive_schema": _archive_schema(parts[_ARCHIVE]) if _ARCHIVE in parts else None,
            "files": sorted(parts),
        }
        _write(file, manifest, parts)
    size = file.stat().st_size
    if as_json:
        print(json.dumps({"file": str(file), "bytes": size, **manifest}))
    else:
        print(f"{file}: {size:,} bytes: {', '.join(sorted(parts)) or 'there was nothing to back up'}")


@contextmanager
def _own_files(path: Path | None, settings: config_file.Config) -> Iterator[dict[str, Path]]:
    """Files of a backup, by their name in it."""
    parts: dict[str, Path] = {}
    if path is not None:
        parts[_CONFIG] = path
    for name in ("load_model", "save_model"):
        model = settings.given.get("kitsune", {}).get(name, "")
        if model and Path(model).is_file():
            parts[f"{_MODELS}/{Path(model).name}"] = Path(model)
    kept = running.model_file(running.state_folder())
    if kept.is_file():
        parts[_KEPT] = kept
    url = _archive_url(settings)
    with tempfile.TemporaryDirectory(prefix="sdnator-backup-") as folder:
        if url.startswith("sqlite:"):
            archive = Path(unquote(urlsplit(url).path))
            if archive.is_file():
                parts[_ARCHIVE] = _copied(archive, Path(folder, _ARCHIVE))
        yield parts


def _archive_url(settings: config_file.Config) -> str:
    found = running.find()
    return found.archive if found is not None else settings.struct("up").archive or running.default_archive()


def _copied(archive: Path, to: Path) -> Path:
    """A consistent snapshot: SQLite's own backup, since a plain copy of a file in use may be inconsistent."""
    try:
        with (
            closing(sqlite3.connect(f"file:{quote(str(archive))}?mode=ro", uri=True)) as source,
            closing(sqlite3.connect(to)) as copy,
        ):
            source.backup(copy)
            copy.execute("PRAGMA journal_mode = DELETE")
    except sqlite3.Error as error:
        raise PipelineError(f"archive {archive} cannot be copied: {error}") from None
    return to


def _archive_schema(archive: Path) -> int:
    with closing(sqlite3.connect(archive)) as connection:
        return int(connection.execute("PRAGMA user_version").fetchone()[0])


def _write(file: Path, manifest: dict[str, Any], parts: dict[str, Path]) -> None:
    """Atomically, so that there is never half a backup; only its owner may read it."""
    new = file.with_name(file.name + ".new")
    try:
        descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, _PRIVATE)
        with os.fdopen(descriptor, "wb") as raw, tarfile.open(fileobj=raw, mode="w:gz") as tar:
            text = json.dumps(manifest, indent=2).encode()
            about = tarfile.TarInfo(_MANIFEST)
            about.size, about.mtime, about.mode = len(text), int(time.time()), _PRIVATE
            tar.addfile(about, io.BytesIO(text))
            for name, path in sorted(parts.items()):
                tar.add(path, name, recursive=False)
        new.replace(file)
    except OSError as error:
        new.unlink(missing_ok=True)
        raise PipelineError(f"{file}: {error.strerror}; check free space and permissions") from None


def restore(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Backup written by `sdnator backup`.")],
    *,
    as_json: Json = False,
) -> None:
    """Restore archive, configuration and models from a backup.

    The archive goes into the data folder, the configuration into the configuration folder, models
    beside the archive, and the kept model into the state folder. Existing files are kept, with
    `.before-restore` appended to their names, and a number from the second time on. If anything fails,
    all files stay as they were. An archive of an older version is migrated; one of a newer version is
    refused. No pipeline may be running.
    Exit codes: 0 restored, 1 a pipeline runs or something cannot be written, 2 the file cannot be used.

    Example: sdnator restore sdnator-backup.tar.gz
    """
    holder = running.holder(running.state_folder())
    if holder is not None:
        raise PipelineError(f"a pipeline is running (process {holder}): stop it with `sdnator down` first")
    data = running.data_folder()
    with tempfile.TemporaryDirectory(prefix="sdnator-restore-") as folder:
        manifest, files = _unpacked(file, Path(folder))
        if _ARCHIVE in files:
            _check_archive(files[_ARCHIVE])
        places = {name: _place(name, data) for name in files}
        kept = _put_back({place: files[name] for name, place in places.items()})
    shown = {str(name): str(place) for name, place in places.items()}
    if as_json:
        print(json.dumps({"made": manifest.get("made"), "files": shown, "kept": [str(one) for one in kept]}))
        return
    for name, place in shown.items():
        print(f"{name} -> {place}")
    for path in kept:
        print(f"existing files kept as: {path}")


def _unpacked(file: Path, folder: Path) -> tuple[dict[str, Any], dict[str, Path]]:
    try:
        with tarfile.open(file, "r:gz") as tar:
            member = tar.extractfile(_MANIFEST)
            manifest = json.loads(member.read()) if member is not None else {}
            if not isinstance(manifest, dict) or not isinstance(manifest.get("schema"), int):
                raise BadInput(f"{file}: this is not a backup of `sdnator backup`")
            if manifest["schema"] > SCHEMA:
                raise BadInput(
                    f"{file} was written by sdnator {manifest.get('version')}, which is newer: update sdnator"
                )
            listed = manifest.get("files", ())
            names = [str(name) for name in listed] if isinstance(listed, list | tuple) else []
            files = {name: folder / name for name in names if _is_ours(name)}
            for name, path in files.items():
                _copy_out(tar, name, path)
    except FileNotFoundError:
        raise BadInput(f"{file}: no such file; check the path of the backup") from None
    except OSError as error:
        if error.errno in _FULL:
            raise PipelineError(
                f"{folder.parent}: no room to unpack {file} ({error.strerror}); free space there, "
                "or set TMPDIR to a folder with more"
            ) from None
        raise BadInput(
            f"{file}: cannot be read ({error.strerror or error}); give a backup written by `sdnator backup`"
        ) from None
    except (tarfile.TarError, EOFError, KeyError, ValueError, RecursionError) as error:
        raise BadInput(
            f"{file}: this is not a backup of `sdnator backup`, or it is damaged ({error})"
        ) from None
    return manifest, files


def _copy_out(tar: tarfile.TarFile, name: str, path: Path) -> None:
    """The content alone, and of regular files: links, owners and modes of the file are not taken over.

    Not `extractall` with a filter, which Python has from 3.11.4 on only.
    """
    member = tar.getmember(name)
    content = tar.extractfile(member) if member.isreg() else None
    if content is None:
        raise tarfile.TarError(f"{name} is not a regular file")
    path.parent.mkdir(mode=0o700, exist_ok=True)
    with content, path.open("xb") as out:
        shutil.copyfileobj(content, out)


def _is_ours(name: str) -> bool:
    """Nothing but what a backup holds, whatever else the file says."""
    if name in (_ARCHIVE, _CONFIG, _KEPT):
        return True
    folder, _, rest = name.partition("/")
    return folder == _MODELS and rest not in ("", ".", "..") and "/" not in rest


def _check_archive(path: Path) -> None:
    """Opening migrates what is older; raises BadInput for what cannot be read."""
    from due.backends import open_archive
    from due.errors import DueError

    try:
        with closing(open_archive(f"sqlite://{quote(str(path))}")) as driver:
            driver.find({"dataKey": "sdnator.restore"})
    except DueError as error:
        raise BadInput(f"the archive in the backup cannot be used: {error}") from None


def _place(name: str, data: Path) -> Path:
    if name == _CONFIG:
        return config_file.configuration_folder() / config_file.NAME
    return running.model_file(running.state_folder()) if name == _KEPT else data / name


def _put_back(files: Mapping[Path, Path]) -> list[Path]:
    """Copy each value to its key, all or none; returns where what was there before is now."""
    place = Path()
    kept: list[Path] = []
    staged: dict[Path, Path] = {}
    try:
        with ExitStack() as undo:
            for place, source in files.items():
                staged[place] = _staged(source, place, undo)
            for place, new in staged.items():
                kept += _set_aside(place, undo)
                _rename(new, place, undo)
            undo.pop_all()
    except OSError as error:
        raise PipelineError(f"{place}: {error.strerror}; check free space and permissions") from None
    return kept


def _staged(source: Path, place: Path, undo: ExitStack) -> Path:
    """A copy beside the place, on the disk."""
    private_folder(place.parent)
    new = place.with_name(place.name + ".new")
    new.unlink(missing_ok=True)
    undo.callback(new.unlink, missing_ok=True)
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _PRIVATE)
    with os.fdopen(descriptor, "wb") as out, source.open("rb") as content:
        shutil.copyfileobj(content, out)
        give_to_owner(out.fileno(), place.parent)
        out.flush()
        os.fsync(out.fileno())
    return new


def _set_aside(place: Path, undo: ExitStack) -> list[Path]:
    """Move what is at the place, with what belongs to it, to a name that nothing has."""
    found = [ending for ending in _WITH_IT if os.path.lexists(f"{place}{ending}")]
    number, kept = 1, f"{place}.before-restore"
    while any(os.path.lexists(kept + ending) for ending in _WITH_IT):
        number += 1
        kept = f"{place}.before-restore-{number}"
    for ending in found:
        _rename(Path(f"{place}{ending}"), Path(kept + ending), undo)
    return [Path(kept + ending) for ending in found[:1]]


def _rename(path: Path, to: Path, undo: ExitStack) -> None:
    path.rename(to)
    undo.callback(to.rename, path)
