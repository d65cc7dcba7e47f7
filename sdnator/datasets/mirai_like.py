"""A capture like the public Mirai set: 50 minutes of benign traffic, then an infection.

    benign.traffic ┐
                   ├─ in order of time ─► NetworkModel.carry ─► OUT.pcap + OUT.labels.csv
    attack.traffic ┘

Label 1 marks packets that an infected device or the intruder sends for the attack, with the sender's MAC.
Label 0 is everything else: benign devices, the infected camera's normal traffic, and answers of victims.
"""

import heapq
import itertools
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from sdnator.capture.captures import CaptureWriter
from sdnator.capture.labels import Labels, labels_path, write_labels
from sdnator.datasets import attack, benign
from sdnator.datasets.network import NetworkModel
from sdnator.datasets.traffic import SECOND, Chance, SentPacket, WireFrame
from sdnator.errors import BadInput

START_S: Final = 1_709_625_600
"""Capture time of the first second: 2024-03-05 08:00 UTC."""
MAX_PACKETS: Final = 250_000
_NEWS_AT: Final = 0.75
"""Share of the time before the infection after which a device takes up a habit not seen before."""
SNAP: Final = 200
"""Bytes kept of a frame, as in the public capture."""


@dataclass(frozen=True)
class MiraiLikeOptions:
    """What to generate."""

    seed: int = 1
    benign_seconds: float = 3_000
    """Benign traffic before the infection, about 27 packets a second."""
    attack_seconds: float = 720
    """From the infection to the end; benign traffic goes on. 0 = no attack."""
    background: bool = True
    """False = the attack and its answers only, to be spliced behind a real capture."""
    plan: attack.AttackPlan = field(default_factory=attack.AttackPlan)
    max_packets: int = MAX_PACKETS


@dataclass(frozen=True)
class Made:
    """What was written."""

    capture: Path
    labels: Path
    packets: int
    attack_packets: int
    first_attack: int | None
    seconds: float


def make(
    options: MiraiLikeOptions, out: str | os.PathLike[str], progress: Callable[[int], None] = lambda _: None
) -> Made:
    """Write the capture and its labels beside it; the same options give the same bytes.

    Args:
        options: what to generate.
        out: pcap to write (gzipped when it ends in `.gz`).
        progress: called with the number of packets written so far.

    Raises:
        BadInput: the options ask for no packet at all.
        OSError: the folder is missing or not writable.
    """
    flags: list[bool] = []
    senders: list[str] = []
    last = 0
    with CaptureWriter(out) as writer:
        for frame in itertools.islice(generate(options), min(options.max_packets, MAX_PACKETS)):
            writer.write(START_S * 1_000_000_000 + frame.time * 1_000, frame.data, frame.length)
            flags.append(bool(frame.attacker))
            senders.append(frame.attacker)
            last = frame.time
            if writer.packets % 1_000 == 0:
                progress(writer.packets)
        if not flags:
            raise BadInput(
                f"{out}: no packet to write; ask for more seconds of benign traffic or of the attack"
            )
        labels = Labels.of(flags, senders)
        write_labels(labels_path(out), labels)
    return Made(
        Path(out), labels_path(out), len(labels), int(labels.attack.sum()), labels.first_attack, last / SECOND
    )


def make_mirai_like(out: str | os.PathLike[str], *, seed: int = 1) -> Made:
    """The default data set: about 160,000 packets, half of them before the infection."""
    return make(MiraiLikeOptions(seed=seed), out)


def generate(options: MiraiLikeOptions) -> Iterator[WireFrame]:
    """The frames of a capture, in order of time."""
    onset = int(options.benign_seconds * SECOND) if options.background else 0
    end = onset + int(options.attack_seconds * SECOND)
    background = benign.traffic(options.seed, 0, end, int(onset * _NEWS_AT)) if options.background else []
    hostile = attack.traffic(options.seed, onset, end, options.plan)
    sent: Iterator[SentPacket] = heapq.merge(background, hostile, key=lambda packet: packet.time)
    return NetworkModel(Chance(options.seed, 3), SNAP, cookies=options.plan.answer_all).carry(sent)
