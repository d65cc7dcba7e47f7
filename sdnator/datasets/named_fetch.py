"""A public data set onto this machine: from its publisher, a mirror, or files that are there already.

publisher or mirror ─► download ─┐
whole archive ─► members ────────┼─► is it what it should be? ─► checksum ─► capture, labels ─► record
--from FILE ─────────────────────┘                                 flows ─► labels of packets ┘
"""

import gzip
import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

from sdnator.capture.captures import Capture
from sdnator.capture.labels import read_labels, write_labels
from sdnator.capture.pcap_records import PCAP_MAGICS, PCAPNG_MAGIC
from sdnator.datasets import local_sets
from sdnator.datasets.catalogue import PublicDataSet, PublishedFile
from sdnator.datasets.fetch import BadSource, NotThere, fetch
from sdnator.datasets.flow_labels import labels_of_flows
from sdnator.datasets.flow_tables import LabelledFlow, read_flow_table
from sdnator.datasets.local_sets import LocalDataSet
from sdnator.datasets.unpacking import UnpackError, check_gzip, content_of, extract, unpack_bzip2
from sdnator.errors import BadInput

Report = Callable[[str], None]
"""Takes one line for people."""
Steps = Callable[[str, int, int | None], None]
"""Takes what is being done, bytes so far and bytes in all."""
_MEMBER_FOLDERS: Final = 2
"""Parts of an address's path that name a file within its set: folder and file."""


@dataclass(frozen=True, kw_only=True)
class FetchRequest:
    """Where a data set shall come from and go to."""

    into: Path
    mirror: str = ""
    """Address that stands for the publisher's server; empty = the publisher."""
    given: Sequence[Path] = ()
    """Files that are there: archive, capture, labels."""
    whole: bool = False
    """Fetch the publication's one archive instead of single files."""
    repin: bool = False
    """Accept other checksums than those of the first fetch."""


@dataclass
class _Pieces:
    """What has been found so far."""

    capture: Path | None = None
    labels: list[Path] = field(default_factory=list)


class DataSetFetch:
    """One data set on its way here.

    Args:
        wanted: from the catalogue.
        request: from where, to where.
        report: called with each line that people should read.
        steps: called as bytes come.
    """

    def __init__(self, wanted: PublicDataSet, request: FetchRequest, report: Report, steps: Steps) -> None:
        self._wanted, self._request, self._report, self._steps = wanted, request, report, steps
        self._pieces = _Pieces()

    def run(self) -> LocalDataSet:
        """Fetch, check, label and record it.

        Raises:
            BadInput: with its reason; `FetchError`, `UnpackError`, `CaptureError`, `LabelsError`, `FlowTableError`.
            OSError: a folder cannot be written.
        """
        self._request.into.mkdir(parents=True, exist_ok=True)
        for path in self._request.given:
            self._take_given(path)
        if not self._request.given:
            self._download()
        found = self._settle()
        local_sets.remember(found)
        return found

    def _take_given(self, path: Path) -> None:
        """A file that is there stays where it is; only members of archives and unpacked copies are written."""
        self._take_any(path.resolve())
        if content_of(path) not in {"zip", "bzip2"}:
            self._pin(path.name, path)

    def _download(self) -> None:
        wanted, archive = self._wanted, self._wanted.publication.archive
        files = [wanted.capture, wanted.labels]
        if self._request.whole:
            if not archive:
                raise BadInput(
                    f"{wanted.name}: there is no archive of the whole set; fetch it without --whole"
                )
            files = [PublishedFile(urls=(archive,))]
        for file in files:
            places = [(place, url) for url in file.urls for place in _places(url, self._request.mirror)]
            if not any(self._fetched(*each) for each in places):
                raise self._not_found([place for place, _ in places])

    def _fetched(self, place: str, url: str) -> bool:
        """Fetch the file of an address from a place; False = it is not there."""
        name = unquote(urlsplit(url).path).rpartition("/")[2].replace(" ", "_")
        target = self._request.into / name
        if target.is_file() and not self._request.repin and self._is_pinned(name, target):
            self._report(f"{target}: is here already, SHA-256 as pinned")
            self._take_any(target)
            return True
        try:
            made = fetch(place, target, progress=self._step_of(name))
        except NotThere:
            return False
        try:
            self._take_any(target)
            self._pin(name, target, made.sha256)
        except BadInput:
            target.unlink()  # nothing stays under this name that is not what it should be
            raise
        return True

    def _not_found(self, places: list[str]) -> NotThere:
        others = f", nor at {len(places) - 1} other addresses that it may have" if len(places) > 1 else ""
        return NotThere(
            f"{self._wanted.name}: not found at {places[0]}{others}; "
            f"{self._elsewhere()}give another server with --mirror URL, or a file that you have with --from FILE "
            f"(see {self._wanted.publication.homepage})"
        )

    def _take_any(self, path: Path) -> None:
        kind = content_of(path)
        if kind == "zip":
            self._take_members(path)
        elif kind == "bzip2":
            target = self._request.into / path.name.removesuffix(".bz2")
            unpack_bzip2(path, target, self._step_of(f"unpacking {path.name}"))
            self._take(target)
        else:
            self._take(path)

    def _elsewhere(self) -> str:
        archive = self._wanted.publication
        if not archive.archive:
            return ""
        return f"fetch the whole publication with --whole ({archive.archive_size}), "

    def _is_pinned(self, name: str, path: Path) -> bool:
        known = local_sets.pinned(self._key(name))
        return bool(known) and known == _sha256(path)

    def _pin(self, name: str, path: Path, sha256: str = "") -> None:
        digest, size = sha256 or _sha256(path), path.stat().st_size
        fresh = local_sets.pin(self._key(name), digest, size, again=self._request.repin)
        how = "pinned from now on" if fresh else "as pinned"
        self._report(f"{path}: {size:,} bytes, SHA-256 {digest} ({how})")

    def _key(self, name: str) -> str:
        return f"{self._wanted.name}/{name}"  # one publication may call files of several captures the same

    def _take_members(self, archive: Path) -> None:
        wanted = (*self._wanted.capture.members, *self._wanted.labels.members)
        found = extract(archive, wanted, self._request.into, self._step_of(f"out of {archive.name}"))
        if not found:
            raise UnpackError(
                f"{archive}: none of {', '.join(wanted)} is in it; give an archive of {self._wanted.title}"
            )
        for path in found:
            self._take(path)
            self._pin(path.name, path)

    def _step_of(self, what: str) -> Callable[[int, int | None], None]:
        return lambda done, total: self._steps(what, done, total)

    def _take(self, path: Path) -> None:
        """Decide by content whether this is the capture or labels, and that it is whole."""
        kind = content_of(path)
        if kind == "page":
            raise BadSource(
                f"{path}: a web page, not a file of {self._wanted.name}; fetch it again or give another"
            )
        if kind == "gzip":
            check_gzip(path)
        if kind == "capture" or (kind == "gzip" and _holds_capture(path)):
            Capture(path).close()
            self._pieces.capture = path
        elif kind in {"gzip", "text"}:
            self._check_labels(path)
            self._pieces.labels.append(path)
        else:
            raise UnpackError(
                f"{path}: neither a capture nor labels ({kind}); give a pcap, pcapng, CSV, gz, bz2 or zip file"
            )

    def _check_labels(self, path: Path) -> None:
        if self._wanted.label_form != "packets":
            next(self._flows(path), None)
            return
        found, published = len(read_labels(path)), self._wanted.packets
        if published is not None and found != published:
            self._report(
                f"note: {path} has {found:,} labels, but the publication mentions {published:,} packets"
            )

    def _flows(self, path: Path) -> Iterator[LabelledFlow]:
        return read_flow_table(path, clock_offset_hours=self._wanted.clock_offset_hours)

    def _settle(self) -> LocalDataSet:
        pieces = self._pieces
        complete = pieces.capture is not None and pieces.labels
        before = None if complete else local_sets.find(self._wanted.name)
        capture = pieces.capture or (before.capture if before else None)
        if capture is None:
            raise BadInput(
                f"{self._wanted.name}: no capture among {', '.join(map(str, self._request.given)) or 'the files'}; "
                "also give it with --from"
            )
        labels = self._labels(capture) if pieces.labels else (before.labels if before else None)
        if labels is None:
            self._report(
                f"{self._wanted.name}: no labels; add them with --from LABELS for figures of quality"
            )
        return LocalDataSet(name=self._wanted.name, capture=capture, labels=labels)

    def _labels(self, capture: Path) -> Path:
        if self._wanted.label_form == "packets":
            return self._pieces.labels[0]
        tables = self._pieces.labels
        made = labels_of_flows(capture, (flow for table in tables for flow in self._flows(table)))
        target = self._request.into / f"{self._wanted.name}.labels.csv"
        write_labels(target, made.labels)
        self._report(
            f"{target}: {int(made.labels.attack.sum()):,} of {len(made.labels):,} packets belong to an attack; "
            f"{made.flows_found:,} of {made.flows:,} attacking flows are in the capture"
        )
        return target


def _places(url: str, mirror: str) -> list[str]:
    """Where a file is looked for: a mirror has the publisher's paths, or the set's folders alone."""
    if not mirror:
        return [url]
    path = urlsplit(url).path.lstrip("/")
    within = "/".join(path.split("/")[-_MEMBER_FOLDERS:])
    return [f"{mirror.rstrip('/')}/{each}" for each in (path, within, path.rpartition("/")[2])]


def _holds_capture(path: Path) -> bool:
    with gzip.open(path) as file:
        head = file.read(4)
    return head in PCAP_MAGICS or head == PCAPNG_MAGIC


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
