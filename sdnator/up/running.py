"""Which pipeline runs on this machine: the run file of `sdnator up`, and the folders of the product.

    $XDG_STATE_HOME/sdnator   run.json, run.lock (with the process id), logs, settings of the parts, spools, model/
    $XDG_DATA_HOME/sdnator    archive.db
    $XDG_CONFIG_HOME/sdnator  sdnator.toml

A running pipeline holds `run.lock`; the kernel releases it even after kill -9, so a stale run file is harmless.
"""

import fcntl
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sdnator.errors import BadInput, PipelineError
from sdnator.northbound import without_user
from sdnator.redaction import redacted_values
from sdnator.user_folders import user_folder

SCHEMA = 3
"""Version of the run file; grows when a reader of the old one would misunderstand it."""
_CLAIM_SECONDS = 1.0


@dataclass(frozen=True, kw_only=True)
class Running:
    """A running pipeline, from its run file."""

    pid: int
    """Of `sdnator up`; SIGTERM ends it in order."""
    started: int
    """UTC, ns."""
    updates: str
    archive: str
    coordinator: str
    """URL of the HTTP API, with its token as `viewer:TOKEN@`."""
    switch: Mapping[str, Any] = field(default_factory=dict)
    """The first: name, address, device_id, target, ports, forward."""
    switches: Sequence[Mapping[str, Any]] = field(default_factory=list)
    """All, each with the same."""
    parts: Mapping[str, int] = field(default_factory=dict)
    """Process ids by name; the last one if a part does not run."""
    health: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """By part: state, restarts, cause of the last death, log_bytes, suppressed_lines,
    out_of_range."""
    logs: str = ""
    dashboard: str = ""
    """URL of the dashboard; empty: there is none."""
    token_file: str = ""
    """File with the token that signs in there."""
    metrics: Mapping[str, str] = field(default_factory=dict)
    """HOST:PORT of Prometheus endpoints, by part."""
    config: str = ""
    """File that was read."""
    model: str = ""
    """What happened to the kept model at the last start of Kitsune; empty: none is kept."""
    schema: int = SCHEMA


def shown(found: Running) -> dict[str, Any]:
    """The run file's content for other programs, without passwords."""
    values = {name: getattr(found, name) for name in found.__dataclass_fields__ if name != "schema"}
    return redacted_values({**values, "coordinator": without_user(found.coordinator)})


def state_folder() -> Path:
    """Folder for state that the next run or other commands use."""
    return user_folder("XDG_STATE_HOME", ".local/state")


def data_folder() -> Path:
    """Folder for data that the user keeps."""
    return user_folder("XDG_DATA_HOME", ".local/share")


def default_archive() -> str:
    """URL of the embedded archive."""
    return f"sqlite://{quote(str(data_folder() / 'archive.db'))}"


def archive_url(given: str) -> str:
    """The archive that was named, in $DUE_ARCHIVE, too, or that of the running or last pipeline."""
    if given or os.environ.get("DUE_ARCHIVE"):
        return given or os.environ["DUE_ARCHIVE"]
    found = find()
    return found.archive if found is not None else default_archive()


def updates_link(folder: Path) -> Path:
    """A link to the socket of the embedded Data Updates server while it runs."""
    return folder / "updates.sock"


def model_file(folder: Path) -> Path:
    """Where the model of a state folder is kept."""
    return folder / "model" / "kitsune.npz"


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Be the one pipeline of a state folder; raises PipelineError where there is one, BadInput for the folder."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(folder / "run.lock", os.O_RDWR | os.O_CREAT, 0o600)
    except OSError as error:
        raise BadInput(
            f"{folder}: {error.strerror}; set XDG_STATE_HOME to a folder that you can write to"
        ) from None
    try:
        _lock(descriptor, folder)
        (folder / "run.json").unlink(missing_ok=True)
        os.ftruncate(descriptor, 0)
        os.write(descriptor, str(os.getpid()).encode())
        yield
        (folder / "run.json").unlink(missing_ok=True)
    finally:
        os.close(descriptor)


def _lock(descriptor: int, folder: Path) -> None:
    """Retries for a moment: commands that check hold the lock while they do so."""
    deadline = time.monotonic() + _CLAIM_SECONDS
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > deadline:
                raise PipelineError(
                    f"a pipeline is already running ({folder}): stop it with `sdnator down`"
                ) from None
            time.sleep(0.02)
        else:
            return


def write(folder: Path, running: Running) -> None:
    """Replace the run file.  Raises OSError."""
    from due.private_files import write_private_json  # the commands load nothing heavy

    write_private_json(folder / "run.json", asdict(running))


def holder(folder: Path) -> int | None:
    """Process id of the pipeline of this state folder, also while it starts and stops; None where there is none.

    Raises PipelineError where another user's pipeline may be running.
    """
    try:
        descriptor = os.open(folder / "run.lock", os.O_RDONLY)
    except PermissionError:
        raise PipelineError(
            f"{folder} is another user's: use sudo, or run this as the user who started the pipeline"
        ) from None
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        written = os.read(descriptor, 32)
        return int(written) if written.isdigit() else None
    else:
        return None
    finally:
        os.close(descriptor)


def find(folder: Path | None = None) -> Running | None:
    """The running pipeline, None if there is none.

    Raises BadInput for a run file of another version, PipelineError for another user's folder.
    """
    folder = folder or state_folder()
    if holder(folder) is None:
        return None
    path = folder / "run.json"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise BadInput(f"{path} cannot be read ({error}): restart the pipeline") from None
    if not isinstance(found, dict) or found.get("schema") != SCHEMA:
        raise BadInput(
            f"{path} was written by another version of sdnator: stop and start the pipeline with this one"
        )
    try:
        return Running(**found)
    except TypeError as error:
        raise BadInput(f"{path} is damaged ({error}): stop the pipeline and start it again") from None


def need() -> Running:
    """The running pipeline; raises PipelineError with a remedy if there is none."""
    found = find()
    if found is None:
        raise PipelineError("no pipeline is running: start one with `sdnator up`")
    return found
