"""`mirai` on the command line: the fetched data set of that name, unless a file is called so."""

from dataclasses import dataclass
from pathlib import Path

from sdnator.datasets import local_sets
from sdnator.datasets.catalogue import CATALOGUE, TrainingLength
from sdnator.errors import BadInput


@dataclass(frozen=True, kw_only=True)
class NamedCapture:
    """What a word on the command line stands for."""

    capture: Path
    labels: Path | None
    training: TrainingLength | None = None
    """As the data set's publication has it; None = a file, or none is published."""
    note: str = ""
    """Which was taken, for people; empty = there was nothing to choose."""


def named_capture(word: Path, labels: Path | None = None) -> NamedCapture:
    """The capture that is meant, and its labels.

    Args:
        word: a path, or the name of a public data set.
        labels: those that the user gave; they win over the data set's.

    Raises:
        BadInput: a data set that has not been fetched, or whose files have gone.
    """
    wanted = CATALOGUE.get(str(word))
    if wanted is None:
        return NamedCapture(capture=word, labels=labels)
    if word.exists():
        return NamedCapture(
            capture=word,
            labels=labels,
            note=f"{word} is taken as the file {word.resolve()}, not as the data set {wanted.name}",
        )
    found = local_sets.find(wanted.name)
    if found is None:
        raise BadInput(
            f"data set {wanted.name} has not been fetched, and there is no file of that name; "
            f"run `sdnator dataset fetch {wanted.name}`"
        )
    chosen = labels or found.labels
    trained = wanted.training
    parts = [f"data set {wanted.name}: {found.capture}", f"labels {chosen or 'none'}"]
    if trained is not None:
        parts.append(f"training: the first {trained.fm_grace + trained.ad_grace:,} packets, as published")
    if wanted.note:
        parts.append(wanted.note)
    return NamedCapture(capture=found.capture, labels=chosen, training=trained, note="; ".join(parts))
