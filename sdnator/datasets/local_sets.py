"""What has been fetched on this machine: where each data set lies, and the checksums of its files.

    $XDG_DATA_HOME/sdnator/datasets/NAME.json       capture, labels, when
    $XDG_DATA_HOME/sdnator/datasets/checksums.json  SHA-256 of each published file, as first seen

The publishers give no checksums, so the first fetch pins them: later ones must bring the same bytes.
"""

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sdnator.datasets.fetch import ChecksumMismatch
from sdnator.errors import BadInput
from sdnator.up import running


@dataclass(frozen=True, kw_only=True)
class LocalDataSet:
    """A data set on this machine."""

    name: str
    capture: Path
    labels: Path | None
    """None = only the capture was given."""


def folder() -> Path:
    """Where data sets go that are fetched without `--into`, and where the records of all are."""
    return running.data_folder() / "datasets"


def remember(found: LocalDataSet) -> None:
    """Record where a data set lies; raises OSError."""
    _write(_record(found.name), asdict(found))


def find(name: str) -> LocalDataSet | None:
    """The data set of this name as it was fetched, None = it was not; raises BadInput where files have gone."""
    record = _read(_record(name))
    if not record:
        return None
    capture, labels = Path(str(record.get("capture"))), record.get("labels")
    found = LocalDataSet(name=name, capture=capture, labels=Path(str(labels)) if labels else None)
    gone = [path for path in (found.capture, found.labels) if path is not None and not path.is_file()]
    if gone:
        raise BadInput(
            f"{gone[0]}: data set {name} was fetched to this path, but the file is gone; "
            f"run `sdnator dataset fetch {name}` again"
        )
    return found


def pinned(file: str) -> str:
    """The SHA-256 that a published file had when it first came, in hex; empty = never fetched."""
    known = _read(_pins()).get(file, {})
    return str(known.get("sha256", "")) if isinstance(known, dict) else ""


def pin(file: str, sha256: str, size: int, *, again: bool = False) -> bool:
    """Pin a file's checksum, or hold it against the pinned one.

    Args:
        file: a published file's name, such as `mirai/Mirai_pcap.pcap.gz`.
        sha256: what it has now, in hex.
        size: in bytes.
        again: True = what was pinned does not count.

    Returns:
        True where it was pinned now, False where it was known and is the same.

    Raises:
        ChecksumMismatch: another one is pinned.
        OSError: the file of checksums cannot be written.
    """
    before = pinned(file)
    if before == sha256:
        return False
    if before and not again:
        raise ChecksumMismatch(
            f"{file}: SHA-256 is {sha256}, but {before} is pinned in {_pins()} since the first fetch: the file is "
            "damaged or has been replaced; fetch it again, or accept the new one with --repin"
        )
    _write(_pins(), _read(_pins()) | {file: {"sha256": sha256, "bytes": size}})
    return True


def _pins() -> Path:
    return folder() / "checksums.json"


def _record(name: str) -> Path:
    return folder() / f"{name}.json"


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        raise BadInput(f"{path}: cannot be read ({error}); delete it and fetch the data sets again") from None
    if not isinstance(found, dict):
        raise BadInput(f"{path}: not a record of data sets; delete it and fetch the data sets again")
    return found


def _write(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    part.write_text(json.dumps(content, indent=2, default=str) + "\n", encoding="utf-8")
    part.replace(path)
