"""Labels of a capture: which packets belong to an attack, and their senders.

Three forms are read, plain or gzipped, told by their first line:

    index,label,attacker        this product's own: indices from 0, attacker empty for benign packets
    0                           bare lines of 0 and 1
    "","x"                      the published Kitsune label file: index (from 1), label

    LabelsError (BadInput, ValueError)
    ├── MissingLabels       no such file or not readable
    ├── MalformedLabels     a line that is none of the three forms
    └── LengthMismatch      not as many labels as packets
"""

import csv
import gzip
import itertools
import os
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self, TextIO

import numpy as np
from numpy.typing import NDArray

from sdnator.capture.table_file import open_table
from sdnator.errors import BadInput

HEADER: Final = "index,label,attacker"
MAX_LINE: Final = 4_096
"""Characters of the longest line that is read."""
MAX_LABELS: Final = 100_000_000
"""Most labels: as many as a capture may have packets."""


class LabelsError(BadInput, ValueError):
    """Labels that cannot be used; the text says what, where and what to do."""


class MissingLabels(LabelsError):
    """No such file or not readable."""


class MalformedLabels(LabelsError):
    """A line that is none of the three forms."""


class LengthMismatch(LabelsError):
    """Not as many labels as packets."""


@dataclass(frozen=True, eq=False)
class Labels:
    """One label per packet, in the order of the capture."""

    attack: NDArray[np.bool_]
    """True = packet of an attack, sent by an attacker (replies of victims are not)."""
    sender: NDArray[np.int32]
    """Index into `names` of the attacking sender; 0 = benign or not named."""
    names: tuple[str, ...]
    """Attacking senders, MAC (lower case, colons) or IP; `names[0]` is the empty name."""

    def __len__(self) -> int:
        return len(self.attack)

    @property
    def attackers(self) -> frozenset[str]:
        """MAC or IP addresses of all attackers; empty where the file names none."""
        return frozenset(self.names[1:])

    @property
    def first_attack(self) -> int | None:
        """Index of the first attack packet."""
        found = int(np.argmax(self.attack)) if len(self) else 0
        return found if len(self) and self.attack[found] else None

    def attacker(self, index: int) -> str:
        """The attacking sender of a packet, empty for benign ones."""
        return self.names[int(self.sender[index])]

    def for_packets(self, packets: int, *, cut: bool = False) -> Self:
        """The labels of a capture of `packets` packets; a cut capture may have more labels than packets.

        Raises:
            LengthMismatch: otherwise.
        """
        if len(self) == packets:
            return self
        if cut and len(self) > packets:
            return type(self)(self.attack[:packets], self.sender[:packets], self.names)
        raise LengthMismatch(
            f"{len(self):,} labels for {packets:,} packets; give the label file that belongs to this capture"
        )

    @classmethod
    def of(cls, attack: Sequence[bool] | NDArray[np.bool_], attackers: Iterable[str] | None = None) -> Self:
        """Labels from a flag and (optionally) a sender for each packet."""
        flags = np.asarray(attack, dtype=np.bool_)
        numbers: dict[str, int] = {"": 0}
        given = attackers if attackers is not None else [""] * len(flags)
        sender = np.fromiter((numbers.setdefault(name, len(numbers)) for name in given), np.int32)
        if len(sender) != len(flags):
            raise LengthMismatch(f"{len(sender):,} senders for {len(flags):,} labels")
        return cls(flags, sender, tuple(numbers))


def labels_path(capture: str | os.PathLike[str]) -> Path:
    """Where the labels of a written capture go: `OUT.pcap` (or `OUT.pcap.gz`) has `OUT.labels.csv`."""
    path = Path(capture)
    name = path.name.removesuffix(".gz")
    return path.with_name(f"{Path(name).stem}.labels.csv")


def read_labels(path: str | os.PathLike[str], packets: int | None = None) -> Labels:
    """Read a label file of any of the three forms.

    Args:
        path: the file, plain or gzipped.
        packets: how many there must be, when known.

    Raises:
        MissingLabels, MalformedLabels, LengthMismatch
    """
    labels = _parse(Path(path))
    if packets is None:
        return labels
    try:
        return labels.for_packets(packets)
    except LengthMismatch as error:
        raise LengthMismatch(f"{path}: {error}") from None


def write_labels(path: str | os.PathLike[str], labels: Labels) -> None:
    """Write this product's own form; the file appears only when it is whole."""
    target = Path(path)
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        with part.open("w", encoding="ascii") as file:
            file.write(f"{HEADER}\n")
            rows = zip(labels.attack.tolist(), labels.sender.tolist(), strict=True)
            file.writelines(f"{i},{flag:d},{labels.names[who]}\n" for i, (flag, who) in enumerate(rows))
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def _parse(path: Path) -> Labels:
    attack: list[bool] = []
    senders: list[str] = []
    try:
        for number, (flag, sender) in enumerate(_rows(path), start=1):
            if flag not in {"0", "1"}:
                raise MalformedLabels(f"{path}: label {number:,} is {flag[:40]!r}; labels are 0 or 1")
            attack.append(flag == "1")
            senders.append(sender)
            if number > MAX_LABELS:
                raise MalformedLabels(f"{path}: more than {MAX_LABELS:,} labels; captures may not be longer")
    except OSError as error:
        if not isinstance(error, gzip.BadGzipFile):
            raise MissingLabels(f"{path}: cannot be read ({error.strerror}); copy it again") from None
        raise MalformedLabels(f"{path}: not a label file ({error}); {_FORMS}") from None
    except (UnicodeDecodeError, csv.Error, EOFError, zlib.error) as error:
        raise MalformedLabels(f"{path}: not a label file ({error}); {_FORMS}") from None
    if not attack:
        raise MalformedLabels(f"{path}: no labels in it; {_FORMS}")
    return Labels.of(attack, senders)


_FORMS: Final = f"give lines of 0/1, the published file, or '{HEADER}' with one line per packet"


def _rows(path: Path) -> Iterator[tuple[str, str]]:
    with open_table(path, MissingLabels, "labels", "a label file", newline="") as file:
        rows = csv.reader(_lines(path, file))
        first = next(rows, None)
        if first is None:
            return
        header = ",".join(first).strip().lower()
        if header == HEADER:
            yield from _indexed(path, rows, start=0, columns=3)
        elif first == ["", "x"]:
            yield from _indexed(path, rows, start=1, columns=2)
        else:
            yield from _bare(path, itertools.chain([first], rows))


def _lines(path: Path, file: TextIO) -> Iterator[str]:
    number = 0
    while line := file.readline(MAX_LINE + 1):
        number += 1
        if len(line) > MAX_LINE:
            raise MalformedLabels(f"{path}: line {number:,} is longer than {MAX_LINE:,} characters; {_FORMS}")
        yield line


def _indexed(path: Path, rows: Iterable[list[str]], start: int, columns: int) -> Iterator[tuple[str, str]]:
    for expected, row in enumerate(rows, start):
        if len(row) != columns:
            raise MalformedLabels(
                f"{path}: line {expected - start + 2:,} has {len(row)} columns, not {columns}"
            )
        if row[0] != str(expected):
            raise MalformedLabels(
                f"{path}: line {expected - start + 2:,} is for packet {row[0]!r} where {expected:,} is due; "
                "labels are in the order of the capture, none left out"
            )
        yield row[1].strip(), row[2].strip().lower() if columns == 3 else ""


def _bare(path: Path, rows: Iterable[list[str]]) -> Iterator[tuple[str, str]]:
    for number, row in enumerate(rows, 1):
        if len(row) != 1:
            raise MalformedLabels(
                f"{path}: line {number:,} has {len(row)} columns and no known header; {_FORMS}"
            )
        yield row[0].strip(), ""
