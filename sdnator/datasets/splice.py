"""One capture behind another: the attack's times are shifted, labels are written for both.

    BENIGN ─────────────────► gap ─► ATTACK ─────► OUT.pcap + OUT.labels.csv

Packets keep their bytes.  Labels of either part are used where there are any; without them every
packet of BENIGN is benign and every packet of ATTACK belongs to the attack, its attacker being the
sender of its first packet.
"""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from sdnator.capture.captures import Capture, CapturedFrame, CaptureWriter, CutCapture
from sdnator.capture.labels import Labels, labels_path, read_labels, write_labels


@dataclass(frozen=True)
class Spliced:
    """What was written."""

    capture: Path
    labels: Path
    benign_packets: int
    attack_packets: int
    cuts: tuple[CutCapture, ...]
    """Parts that were not whole."""


def splice(
    benign: str | os.PathLike[str],
    attack: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    gap_ns: int = 1_000_000_000,
    progress: Callable[[int], None] = lambda _: None,
) -> Spliced:
    """Write BENIGN and behind it ATTACK, whose first packet comes `gap_ns` after the last of BENIGN.

    Args:
        benign, attack: captures in any form that `Capture` reads; labels beside them (`X.labels.csv`)
            are used.
        out: pcap to write (gzipped when it ends in `.gz`); ns times when one of the parts needs them.
        gap_ns: nanoseconds between the parts, not negative.
        progress: called with the number of packets written so far.

    Raises:
        CaptureError: a part cannot be read.
        LabelsError: labels beside a part cannot be read or do not belong to it.
        ValueError: a negative gap.
        OSError: `out` cannot be written.
    """
    if gap_ns < 0:
        raise ValueError(f"gap of {gap_ns} ns: parts cannot overlap; give 0 or more")
    parts = (_Part(benign, attack=False), _Part(attack, attack=True))
    nanoseconds = any(part.nanoseconds for part in parts)
    shift = parts[0].last_ns + gap_ns - parts[1].first_ns
    with CaptureWriter(out, nanoseconds=nanoseconds) as writer:
        for part, offset in zip(parts, (0, shift), strict=True):
            for frame in part.frames():
                writer.write(frame.time_ns + offset, frame.data, frame.length)
                if writer.packets % 1_000 == 0:
                    progress(writer.packets)
        write_labels(labels_path(out), _joined([part.labels for part in parts]))
    cuts = tuple(part.cut for part in parts if part.cut is not None)
    first, second = (len(part.labels) for part in parts)
    return Spliced(Path(out), labels_path(out), first, second, cuts)


def _joined(parts: list[Labels]) -> Labels:
    return Labels.of(
        [flag for labels in parts for flag in labels.attack.tolist()],
        [labels.attacker(index) for labels in parts for index in range(len(labels))],
    )


class _Part:
    """A capture read once for its times and its labels, and once more for its frames."""

    def __init__(self, path: str | os.PathLike[str], *, attack: bool) -> None:
        self._path = Path(path)
        with Capture(path) as capture:
            self.first_ns = self.last_ns = capture.first_time_ns
            self.nanoseconds = False
            sender = b""
            for frame in capture:
                sender = sender or frame.data[6:12]
                self.first_ns = min(self.first_ns, frame.time_ns)
                self.last_ns = max(self.last_ns, frame.time_ns)
                self.nanoseconds |= frame.time_ns % 1_000 != 0
            self.cut = capture.cut
            packets = capture.packets
        self.labels = self._labels(packets, sender.hex(":") if attack else "")

    def _labels(self, packets: int, attacker: str) -> Labels:
        beside = labels_path(self._path)
        if beside.exists():
            return read_labels(beside).for_packets(packets, cut=self.cut is not None)
        return Labels.of([bool(attacker)] * packets, [attacker] * packets)

    def frames(self) -> Iterator[CapturedFrame]:
        with Capture(self._path) as capture:
            yield from capture
