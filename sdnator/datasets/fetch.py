"""Download of a published data set: resumes where it was interrupted, checks the checksum.

URL ──► .NAME.part (+ .NAME.part.json: which URL, which version) ──► checksum ──► NAME

FetchError (BadInput)
├── BadSource           not an http(s) URL, or the server refuses
│   └── NotThere        the server says 404 or 410
├── WrongContent        a web page came instead of the file
├── DiskFull            no room for the file; what is there is kept
├── Interrupted         the connection broke more often than is tried again; what is there is kept
└── ChecksumMismatch    what came is not what was expected; it is thrown away
"""

import errno
import hashlib
import http.client
import json
import os
import shutil
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sdnator.errors import BadInput

_CHUNK: Final = 1 << 18
_TIMEOUT_S: Final = 30
_HTTP_PARTIAL, _HTTP_RANGE_WRONG = 206, 416
_GONE: Final = (404, 410)
_FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_RESERVE_BYTES: Final = 16 << 20
"""Room that a download leaves on the disk."""

Progress = Callable[[int, int | None], None]


class FetchError(BadInput):
    """A data set that could not be fetched; the text says what, where and what to do."""


class BadSource(FetchError):
    """Not an http(s) URL, or the server refuses."""


class NotThere(BadSource):
    """The server has nothing at this address."""


class WrongContent(FetchError):
    """A web page came instead of the file, or something else that it cannot be."""


class DiskFull(FetchError):
    """No room for the file; what has come is kept for the next try."""


class Interrupted(FetchError):
    """The connection broke; what has come is kept for the next try."""


class ChecksumMismatch(FetchError):
    """What came is not what was expected."""


@dataclass(frozen=True)
class Fetched:
    """A file that is whole."""

    path: Path
    bytes: int
    resumed_at: int
    """Bytes that an earlier, interrupted download had left; 0 = from the start."""
    sha256: str


@dataclass
class _Part:
    """The unfinished file and what it is a part of."""

    target: Path
    url: str

    def __post_init__(self) -> None:
        self.path = self.target.with_name(f".{self.target.name}.part")
        self.note = self.target.with_name(f".{self.target.name}.part.json")
        self.version = ""
        if self.path.exists() and self.note.exists():
            self.version = self._noted_version()
        if not self.version:  # nothing says what the bytes at hand belong to
            self.path.unlink(missing_ok=True)

    def _noted_version(self) -> str:
        try:
            known = json.loads(self.note.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):  # a note cut off by a crash: start again
            return ""
        if not isinstance(known, dict) or known.get("url") != self.url:
            return ""
        return str(known.get("version", ""))

    @property
    def size(self) -> int:
        return self.path.stat().st_size if self.path.exists() else 0

    def belongs_to(self, version: str) -> None:
        self.version = version
        self.note.write_text(json.dumps({"url": self.url, "version": version}), encoding="utf-8")

    def drop(self) -> None:
        self.path.unlink(missing_ok=True)
        self.note.unlink(missing_ok=True)


def fetch(
    url: str,
    target: str | os.PathLike[str],
    *,
    sha256: str = "",
    tries: int = 5,
    progress: Progress = lambda _done, _total: None,
) -> Fetched:
    """Download a file; it appears under its name only when it is whole and its checksum is right.

    Args:
        url: http or https.
        target: file to write; its folder is made.
        sha256: expected checksum in hex; empty = none is checked.
        tries: how often a broken connection is taken up again.
        progress: called with bytes so far and, where the server tells it, bytes in all.

    Raises:
        BadSource, WrongContent, DiskFull, Interrupted, ChecksumMismatch
        OSError: `target` cannot be written.
    """
    if urllib.parse.urlsplit(url).scheme not in {"http", "https"}:
        raise BadSource(f"{url}: not an http or https address; give the URL of the file")
    target = Path(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    part = _Part(target, url)
    resumed_at = part.size
    for attempt in range(tries):
        try:
            if _continue(part, progress):
                return _finish(part, sha256.lower(), resumed_at)
        except urllib.error.HTTPError as error:
            kind = NotThere if error.code in _GONE else BadSource
            raise kind(f"{url}: the server answers {error.code} {error.reason}; check the URL") from None
        except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
            if attempt == tries - 1:
                raise _interrupted(part, error) from None
    raise _interrupted(part, None)


def _interrupted(part: _Part, error: Exception | None) -> Interrupted:
    reason = getattr(error, "reason", error) or "the server closes the connection too early"
    if not part.size:
        return Interrupted(
            f"{part.url}: no data arrived ({reason}); check the connection, or fetch it from another server"
        )
    return Interrupted(
        f"{part.url}: download interrupted after {part.size:,} bytes ({reason}); "
        "run the command again to continue where it ended"
    )


def _continue(part: _Part, progress: Progress) -> bool:
    """One connection; True when the file is whole."""
    request = urllib.request.Request(part.url, headers={"User-Agent": "sdnator"})  # noqa: S310 - checked above
    if part.size and part.version:
        request.add_header("Range", f"bytes={part.size}-")
        request.add_header("If-Range", part.version)
    try:
        response = urllib.request.urlopen(request, timeout=_TIMEOUT_S)  # noqa: S310
    except urllib.error.HTTPError as error:
        if error.code != _HTTP_RANGE_WRONG:
            raise
        error.close()
        part.drop()  # longer than the file on the server: start again
        return False
    with response:
        fresh = response.status != _HTTP_PARTIAL
        if not fresh and not response.headers.get("Content-Range", "").startswith(f"bytes {part.size}-"):
            part.drop()  # another part than was asked for: start again
            return False
        _refuse_page(part.url, response.headers.get_content_type())
        if fresh:
            part.belongs_to(response.headers.get("ETag") or response.headers.get("Last-Modified") or "")
        done = 0 if fresh else part.size
        length = response.headers.get("Content-Length", "")
        total = done + int(length) if length.isdecimal() else None
        _refuse_overflow(part, (total or 0) - done)
        _store(part, response, done, total, progress)
        return total is None or part.size >= total


def _store(
    part: _Part, response: http.client.HTTPResponse, done: int, total: int | None, progress: Progress
) -> None:
    try:
        with part.path.open("ab" if done else "wb") as file:
            while chunk := response.read1(_CHUNK):
                file.write(chunk)
                done += len(chunk)
                progress(done, total)
    except OSError as error:
        if error.errno in _FULL:
            raise _disk_full(part, 0) from None
        raise


def _refuse_page(url: str, kind: str) -> None:
    """A portal that wants a registration, or an error page with status 200."""
    if kind in {"text/html", "application/xhtml+xml"}:
        raise WrongContent(
            f"{url}: a web page came instead of the file (the publisher may ask for a registration, or has moved "
            "it); fetch it with a browser and give it with --from FILE, or give another place with --mirror URL"
        )


def _refuse_overflow(part: _Part, missing: int) -> None:
    if missing and missing + _RESERVE_BYTES > shutil.disk_usage(part.path.parent).free:
        raise _disk_full(part, missing)


def _disk_full(part: _Part, missing: int) -> DiskFull:
    needed = f"{missing:,} bytes are missing" if missing else "the disk is full"
    free = shutil.disk_usage(part.path.parent).free
    return DiskFull(
        f"{part.target}: no room for it: {needed}, {free:,} bytes are free in {part.path.parent}; make room and "
        "run the command again to continue, or choose another folder"
    )


def _finish(part: _Part, expected: str, resumed_at: int) -> Fetched:
    with part.path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    size = part.size
    if expected and digest != expected:
        part.drop()
        raise ChecksumMismatch(
            f"{part.url}: SHA-256 is {digest}, expected {expected}; the download was thrown away: "
            "fetch it again, or check the expected checksum"
        )
    part.path.replace(part.target)
    part.note.unlink(missing_ok=True)
    return Fetched(part.target, size, resumed_at, digest)
