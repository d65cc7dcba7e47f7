"""Innocent traffic before the firewall's SYN logic: how many decisions does it make?  None, one hopes.

The firewall service runs as it is, without backends: what the Sonata adapter would publish is pushed
into it.  The public capture's table has no TCP flags, so all its TCP packets count as SYNs that nobody
answers: worse than they were.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from reactivex.subject import Subject

from apps.firewall.service import FirewallService
from apps.firewall.settings import Settings
from apps.packets import read_frames
from due import Item, RecordBatch
from sdnator.datasets import mirai_like
from sdnator.tshark_tsv import read_batches

_ROWS = 256
_SYNS = "network.traffic_capture.sonata.tcp"
_SYN, _ACK_RST_FIN = 0x02, 0x15


class _Engine:
    """What the firewall needs of DUE, for one process."""

    def __init__(self) -> None:
        self.subjects: dict[str, Subject[Item]] = {}
        self.written: list[tuple[str, Any]] = []

    def observe(self, key: str) -> "Subject[Item]":
        return self.subjects.setdefault(key.partition(":")[0], Subject())

    def get(self, _: Any) -> list[Item]:
        return []

    def write(self, key: str, value: Any, *_: Any, **__: Any) -> bool:
        self.written.append((key, value))
        return True


def decisions_on(batches: Iterator[RecordBatch]) -> int:
    """Blocks and guards that SYNs of these packets lead to."""
    engine: Any = _Engine()
    firewall = FirewallService(engine, Settings())
    firewall.start()
    for number, batch in enumerate(batches):
        time_ns = int(batch["time_us"][-1]) * 1000
        item = Item(_SYNS, batch, time_ns, time_ns, "sonata_adapter", "innocent", number)
        engine.subjects[_SYNS].on_next(item)
        firewall.tick()
    return sum(key.split(".")[1] in ("block", "protect") for key, _ in engine.written)


def public_capture(table: Path) -> Iterator[RecordBatch]:
    """All TCP packets of the public capture."""
    for batch in read_batches(table):
        yield from _pieces(batch.take(np.flatnonzero((batch["tcp_dport"] >= 0) & (batch["quoted"] == 0))))


def generated_day(seconds: float, seed: int) -> Iterator[RecordBatch]:
    """SYNs of generated benign traffic."""
    frames = list(
        mirai_like.generate(mirai_like.Options(seed=seed, benign_seconds=seconds, attack_seconds=0))
    )
    number = np.arange(len(frames))
    batch = read_frames(
        [frame.data for frame in frames],
        lengths=[frame.length for frame in frames],
        times_us=[frame.time // 1000 for frame in frames],
        ports=np.ones(len(frames)),
        sequence=number,
        arrival=number,
    )
    flags = batch["tcp_flags"]
    yield from _pieces(batch.take(np.flatnonzero((flags & _SYN != 0) & (flags & _ACK_RST_FIN == 0))))


def _pieces(batch: RecordBatch) -> Iterator[RecordBatch]:
    for begin in range(0, len(batch), _ROWS):
        yield batch.take(np.arange(begin, min(begin + _ROWS, len(batch))))
