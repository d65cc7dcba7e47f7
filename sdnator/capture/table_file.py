"""Tables of text that belong to a capture, plain or gzipped, told by their first bytes."""

import gzip
from pathlib import Path
from typing import TextIO


def open_table(
    path: Path,
    missing: type[Exception],
    noun: str,
    wanted: str,
    *,
    encoding: str = "ascii",
    newline: str = "\n",
) -> TextIO:
    """Open a table to read.

    Args:
        path: of the file.
        missing: error to raise.
        noun: what the path is of, for its message.
        wanted: what to give instead of a file that cannot be read, for its message.
        encoding: of the text.
        newline: as for `open`.
    """
    try:
        with path.open("rb") as file:
            packed = file.read(2) == b"\x1f\x8b"
        if packed:
            return gzip.open(path, "rt", encoding=encoding, newline=newline)
        return path.open(encoding=encoding, newline=newline)
    except FileNotFoundError:
        raise missing(f"{path}: no such file; check the path of the {noun}") from None
    except OSError as error:
        raise missing(f"{path}: cannot be read ({error.strerror}); give {wanted}") from None
