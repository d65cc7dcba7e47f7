"""The available queries: the catalogue, and a folder with the user's own."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from apps.sonata_adapter.errors import QueryError, QueryTextError
from apps.sonata_adapter.query.catalogue import CATALOGUE, Template
from apps.sonata_adapter.query.text import MOST_TEXT, parse_queries

SUFFIX: Final = ".sonata"
VARIABLE: Final = "SDNATOR_QUERIES"
"""Environment variable with the folder of the user's own queries."""


def own_queries() -> Path:
    """The user's folder, `$SDNATOR_QUERIES` or `~/.local/share/sdnator/queries`."""
    given = os.environ.get(VARIABLE)
    return Path(given) if given else Path.home() / ".local" / "share" / "sdnator" / "queries"


class QueryFolder:
    """A folder with one file for each query; it need not exist."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def templates(self) -> dict[str, Template]:
        """The catalogue and the folder's queries; raises `QueryTextError`, OSError."""
        found = dict(CATALOGUE)
        for file in sorted(self.path.glob(f"*{SUFFIX}")) if self.path.is_dir() else ():
            found |= {one.name: one for one in parse_queries(read_text(file), file.name)}
        return found

    def add(self, templates: Sequence[Template], text: str) -> None:
        """Keep queries and their text; raises `QueryError` for names of the catalogue, OSError."""
        _refuse_known(template.name for template in templates)
        self.path.mkdir(parents=True, exist_ok=True)
        target = self.path / f"{'+'.join(template.name for template in templates)[:200]}{SUFFIX}"
        part = target.with_suffix(".part")
        part.write_text(text, encoding="utf-8")
        part.replace(target)


def read_text(file: Path, name: str = "") -> str:
    """A file of queries; raises `QueryTextError`, which calls it `name`, for one that is too long or no text, OSError."""
    with file.open("rb") as opened:
        data = opened.read(4 * MOST_TEXT + 1)  # a character has four bytes at most
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise QueryTextError(name or file.name, line, 1, "not UTF-8 text") from None


def _refuse_known(names: Iterable[str]) -> None:
    for name in names:
        if name in CATALOGUE:
            raise QueryError(f"query {name} is one of the catalogue; give yours another name")
