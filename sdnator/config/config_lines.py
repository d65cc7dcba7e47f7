"""Line of an option in a TOML file.  `tomllib` has no line numbers, so statements are read one by one."""

import tomllib
from collections import Counter
from collections.abc import Iterator
from typing import Any

Path = tuple[str | int, ...]


def lines_of(text: str) -> dict[Path, int]:
    """The line, from 1, of each table and option of a valid TOML text; of arrays of tables by index."""
    found: dict[Path, int] = {}
    counted: Counter[Path] = Counter()
    prefix: Path = ()
    for number, statement in _statements(text):
        parsed = tomllib.loads(statement)
        if statement.lstrip().startswith("["):
            prefix = _header(parsed)
            if statement.lstrip().startswith("[["):
                prefix = (*prefix, counted[prefix])
                counted[prefix[:-1]] += 1
            _note(found, prefix, number)
        else:
            for path in _leaves(parsed):
                _note(found, (*prefix, *path), number)
    return found


def _statements(text: str) -> Iterator[tuple[int, str]]:
    """Headers and assignments with the line they begin in; values may span several lines."""
    began, held = 0, ""
    for number, line in enumerate(text.splitlines(), start=1):
        if not held and (not line.strip() or line.lstrip().startswith("#")):
            continue
        began, held = (began, f"{held}\n{line}") if held else (number, line)
        try:
            tomllib.loads(held)
        except tomllib.TOMLDecodeError:
            continue
        yield began, held
        held = ""


def _header(parsed: Any) -> Path:
    path: Path = ()
    while parsed:
        if isinstance(parsed, list):
            parsed = parsed[0]
            continue
        name = next(iter(parsed))
        path, parsed = (*path, name), parsed[name]
    return path


def _leaves(parsed: dict[str, Any]) -> Iterator[Path]:
    for name, value in parsed.items():
        yield (name,)
        if isinstance(value, dict):
            for path in _leaves(value):
                yield (name, *path)


def _note(found: dict[Path, int], path: Path, number: int) -> None:
    for end in range(1, len(path) + 1):
        found.setdefault(path[:end], number)
