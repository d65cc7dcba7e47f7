"""Innocent traffic before the firewall's SYN logic: how many decisions does it make?  No block, one hopes.

The firewall service runs as it is, without backends, on the traffic's own clock: what the Sonata adapter
would publish is pushed into it.  The generated 50 minutes have devices whose server is gone, and which send it
840 SYNs a second for a while: a service may be guarded for that, nobody may be blocked.  The public capture's
table has no TCP flags, so all its TCP packets count as SYNs that nobody answers: worse than they were.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from reactivex.subject import Subject

from apps.firewall import service
from apps.firewall.settings import Settings
from apps.packets import read_frames
from due import Item, RecordBatch
from sdnator.capture.tshark_tsv import read_batches
from sdnator.datasets import mirai_like

_ROWS = 64
_TICK_S = 0.05
_GAP_S = 10.0
"""Of longer silence only so much is lived through."""
_SYNS, _SYN_ACKS = (f"network.traffic_capture.sonata.tcp:flag={flag}" for flag in ("syn", "syn+ack"))
_SYN, _ACK, _RST_FIN = 0x02, 0x10, 0x05


class _Engine:
    """What the firewall needs of DUE, for one process."""

    def __init__(self) -> None:
        self.subjects: dict[str, Subject[Item]] = {}
        self.written: list[tuple[str, Any]] = []

    def observe(self, key: str) -> "Subject[Item]":
        return self.subjects.setdefault(key, Subject())

    def get(self, _: Any) -> list[Item]:
        return []

    def write(self, key: str, value: Any, *_: Any, **__: Any) -> bool:
        self.written.append((key, value))
        return True


class _Clock:
    """Stands for the module `time`."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    def time_ns(self) -> int:
        return int(self.now * 1e9)


def decisions_on(batches: Iterator[RecordBatch]) -> Counter[str]:
    """Blocks ("block") and guards ("protect") that SYNs and SYN-ACKs of these packets lead to."""
    engine: Any = _Engine()
    clock = _Clock()
    with mock.patch.object(service, "time", clock):
        firewall = service.FirewallService(engine, Settings())
        firewall.start()
        for number, batch in enumerate(batches):
            time_us = int(batch["time_us"][-1])
            _live(firewall, clock, time_us / 1e6)
            for key, part in _captured(batch):
                item = Item(key, part, time_us * 1000, time_us * 1000, "sonata_adapter", "innocent", number)
                engine.subjects[key].on_next(item)
        _live(firewall, clock, clock.now + _GAP_S)
    return Counter(key.split(".")[1] for key, _ in engine.written)


def _live(firewall: service.FirewallService, clock: _Clock, until: float) -> None:
    clock.now = max(clock.now, until - _GAP_S)
    while clock.now + _TICK_S < until:
        clock.now += _TICK_S
        firewall.tick()
    clock.now = max(clock.now, until)


def _captured(batch: RecordBatch) -> Iterator[tuple[str, RecordBatch]]:
    """What the firewall's two captures make of the packets."""
    if "tcp_flags" not in batch:
        yield _SYNS, batch
        return
    answers = batch["tcp_flags"] & _ACK != 0
    for key, chosen in ((_SYNS, ~answers), (_SYN_ACKS, answers)):
        if chosen.any():
            yield key, batch.take(np.flatnonzero(chosen))


def public_capture(table: Path) -> Iterator[RecordBatch]:
    """All TCP packets of the public capture."""
    for batch in read_batches(table):
        yield from _pieces(batch.take(np.flatnonzero((batch["tcp_dport"] >= 0) & (batch["quoted"] == 0))))


def generated_day(seconds: float, seed: int) -> Iterator[RecordBatch]:
    """SYNs and SYN-ACKs of generated benign traffic."""
    frames = list(
        mirai_like.generate(mirai_like.MiraiLikeOptions(seed=seed, benign_seconds=seconds, attack_seconds=0))
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
    yield from _pieces(batch.take(np.flatnonzero((flags & _SYN != 0) & (flags & _RST_FIN == 0))))


def _pieces(batch: RecordBatch) -> Iterator[RecordBatch]:
    for begin in range(0, len(batch), _ROWS):
        yield batch.take(np.arange(begin, min(begin + _ROWS, len(batch))))
