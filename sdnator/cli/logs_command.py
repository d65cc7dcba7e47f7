"""`sdnator logs`: logs of the parts of the running or the last pipeline."""

import json
import os
import re
import signal
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import typer

from sdnator.errors import BadInput
from sdnator.up import running

_LOOK_SECONDS = 0.2
_READ_BYTES = 1 << 20
_STAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d[.,]?\d*")


@dataclass
class _Log:
    part: str
    path: Path
    position: int = 0
    inode: int = 0
    rest: bytes = field(default=b"")

    def tail(self, count: int) -> list[str]:
        """The last lines; `more` returns later ones."""
        with suppress(OSError), self.path.open("rb") as file:
            self.inode = os.fstat(file.fileno()).st_ino
            end = file.seek(0, os.SEEK_END)
            file.seek(max(0, end - _READ_BYTES))
            lines = file.read().split(b"\n")
            self.position, self.rest = file.tell(), lines.pop()
            return [line.decode("utf-8", "replace") for line in deque(lines, count)]
        return []

    def more(self) -> list[str]:
        """Whole lines since the last call; a rotated file is read from its start."""
        with suppress(OSError), self.path.open("rb") as file:
            now = os.fstat(file.fileno())
            if now.st_ino != self.inode or now.st_size < self.position:
                self.inode, self.position, self.rest = now.st_ino, 0, b""
            file.seek(self.position)
            lines = (self.rest + file.read(_READ_BYTES)).split(b"\n")
            self.position, self.rest = file.tell(), lines.pop()
            return [line.decode("utf-8", "replace") for line in lines]
        return []


def logs(
    part: Annotated[
        str, typer.Argument(metavar="PART", help="Part, as named by `sdnator status`; default: all.")
    ] = "",
    *,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Show new lines until Ctrl-C.")] = False,
    lines: Annotated[
        int, typer.Option("--lines", "-n", help="Number of lines to show of each part, the last ones.", min=0)
    ] = 20,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object per line: part and line, parsed if it is JSON.")
    ] = False,
) -> None:
    """Show the logs of the pipeline's parts.

    Lines of several parts are sorted by time.
    Exit codes: 0 shown, 2 no such part.

    Example: sdnator logs kitsune --follow
    """
    found = _find(part)
    alone = bool(part)
    for name, line in in_order([(log.part, log.tail(lines)) for log in found]):
        _print(name, line, alone=alone, as_json=as_json)
    if follow:
        _follow(found, part, alone=alone, as_json=as_json)


def _folder() -> Path:
    return running.state_folder() / "logs"


def _find(part: str) -> list[_Log]:
    known = [_Log(path.stem, path) for path in sorted(_folder().glob("*.log"))]
    if not known:
        raise BadInput(f"{_folder()}: no logs: no pipeline was started here; see `sdnator up`")
    if part and part not in {log.part for log in known}:
        raise BadInput(
            f"part {part}: it has no logs; there are logs of {', '.join(log.part for log in known)}"
        )
    return [log for log in known if part in ("", log.part)]


def in_order(tails: Sequence[tuple[str, Sequence[str]]]) -> list[tuple[str, str]]:
    """Lines of several logs sorted by time; a line without a time (of a traceback) follows the one before it."""
    stamped = []
    for part, lines in tails:
        stamp = ""
        for number, line in enumerate(lines):
            stamp = _stamp(line) or stamp
            stamped.append((stamp, part, number, line))
    return [(part, line) for _, part, _, line in sorted(stamped)]


def _stamp(line: str) -> str:
    # a structured line contains its time, too
    found = _STAMP.search(line[:80])
    return found[0].replace("T", " ").replace(",", ".") if found else ""


def _print(part: str, line: str, *, alone: bool, as_json: bool) -> None:
    if as_json:
        print(json.dumps({"part": part, "line": _parsed(line)}, ensure_ascii=False), flush=True)
    else:
        print(line if alone else f"{part:<14} {line}", flush=True)


def _parsed(line: str) -> object:
    if line.startswith("{"):
        with suppress(ValueError, RecursionError):
            return json.loads(line)
    return line


def _follow(found: list[_Log], part: str, *, alone: bool, as_json: bool) -> None:
    stopped: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda got, _: stopped.append(got))
    while not stopped:
        time.sleep(_LOOK_SECONDS)
        found += _newcomers(found, part)
        for log in found:
            for line in log.more():
                _print(log.part, line, alone=alone, as_json=as_json)


def _newcomers(found: list[_Log], part: str) -> list[_Log]:
    """Parts that have begun to log since the last call."""
    known = {log.path for log in found}
    return [
        _Log(path.stem, path) for path in sorted(_folder().glob("*.log")) if not part and path not in known
    ]
