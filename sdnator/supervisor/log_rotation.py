"""Keeps the logs of running parts within bounds.

The parts write to files opened for appending, so a log is rotated by copying and truncating it.  This needs
no pipe that could fill up and no cooperation of the part.  A line written between copy and truncation is
lost.
"""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from sdnator.supervisor.spec import LogLimits

_MINUTE_S = 60.0
_CHUNK = 1 << 20


@dataclass
class _Watched:
    """State of one log."""

    path: Path
    begun: float
    """When its minute began, s."""
    grown: int = 0
    """Bytes in this minute up to `size`."""
    size: int = 0
    suppressed: int = 0
    """Lines of this minute."""


class LogKeeper:
    """Rotates logs and suppresses lines beyond a minute's limit.

    Args:
        limits: for each log.
    """

    def __init__(self, limits: LogLimits) -> None:
        self._limits = limits
        self._watched: dict[Path, _Watched] = {}
        self._suppressed: dict[Path, int] = {}

    def look(self, path: Path, now: float) -> None:
        """Call about once per second for each log; `now` in seconds.  Never raises: a full disk must not
        end the pipeline."""
        try:
            self._look(self._watched.setdefault(path, _Watched(path, now)), now)
        except OSError:
            return

    def suppressed(self, path: Path) -> int:
        """Lines of a log that were suppressed so far."""
        return self._suppressed.get(path, 0)

    def size(self, path: Path) -> int:
        """Bytes of a log and of what was put aside of it."""
        return sum(_size(each) for each in (path, *_older(path, self._limits.files)))

    def _look(self, log: _Watched, now: float) -> None:
        size = log.path.stat().st_size
        # a log that is shorter than before was truncated
        log.grown += size - log.size if size >= log.size else size
        log.size = size
        share = self._limits.minute_bytes
        if log.grown > share:
            self._cut(log, max(0, size - (log.grown - share)))
            log.grown = share
        if now - log.begun >= _MINUTE_S:
            self._end_minute(log)
            log.begun, log.grown = now, 0
        if log.size > self._limits.file_bytes:
            self._put_aside(log)

    def _cut(self, log: _Watched, at: int) -> None:
        """Truncate after the last complete line before `at`."""
        with log.path.open("r+b") as file:
            kept = _line_end(file, at)
            file.seek(kept)
            lines = 0
            while chunk := file.read(_CHUNK):
                lines += chunk.count(b"\n")
            file.truncate(kept)
        log.size = kept
        log.suppressed += lines
        self._suppressed[log.path] = self._suppressed.get(log.path, 0) + lines

    def _end_minute(self, log: _Watched) -> None:
        if not log.suppressed:
            return
        text = f"sdnator: {log.suppressed:,} lines suppressed: more than {self._limits.minute_bytes:,} bytes a minute\n"
        with log.path.open("ab") as file:
            file.write(text.encode())
        log.size, log.suppressed = _size(log.path), 0

    def _put_aside(self, log: _Watched) -> None:
        put_aside(log.path, self._limits.files, copy=True)
        log.size = 0


def put_aside(path: Path, files: int, *, copy: bool = False) -> None:
    """NAME.log becomes NAME.log.1, that NAME.log.2, and so on, `files` in all; `copy`: it is still written to."""
    older = _older(path, files)
    for newer, to in reversed(list(zip((path, *older), older, strict=False))):
        if newer.exists() and not (copy and newer == path):
            newer.replace(to)
    if copy:
        if older:
            shutil.copyfile(path, older[0])
        os.truncate(path, 0)


def _older(path: Path, files: int) -> list[Path]:
    return [path.with_name(f"{path.name}.{number}") for number in range(1, files)]


def _line_end(file: BinaryIO, at: int) -> int:
    """The end of the last complete line before `at`; `at` itself if a line is longer than a chunk."""
    begin = max(0, at - _CHUNK)
    file.seek(begin)
    found = file.read(at - begin).rfind(b"\n")
    return begin + found + 1 if found >= 0 or begin == 0 else at


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
