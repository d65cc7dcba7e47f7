"""Innocent traffic before the firewall's SYN logic: how many decisions does it make?  No block, one hopes.

The firewall service runs as it is, without backends, on the traffic's own clock: what the Sonata adapter
would publish is pushed into it.  The generated 50 minutes have devices whose server is gone, and which send it
840 SYNs a second for a while: a service may be guarded for that, nobody may be blocked.  The public capture's
table has no TCP flags, so all its TCP packets count as SYNs that nobody answers: worse than they were.
"""

from collections import Counter
from collections.abc import Iterator
from ipaddress import ip_address
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import numpy as np
from reactivex.subject import Subject

from apps.firewall import service
from apps.firewall.settings import Settings
from apps.firewall.syn.flood_handler import TELEMETRY
from apps.packets import read_frames
from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.keys import QUERY_PREFIX, request_of
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.results import QueryResult
from due import Item, RecordBatch
from sdnator.capture.tshark_tsv import read_batches
from sdnator.datasets import mirai_like

_ROWS = 64
_TICK_S = 0.05
_GAP_S = 10.0
"""Of longer silence only so much is lived through."""
_SYN_ACKS = "network.traffic_capture.sonata.tcp:flag=syn+ack"
_PACKETS = "network.packets.p4runtime_ctrl.s1"
_DECISIONS = ("block", "protect", "meter")
_LOW = (1 << 64) - 1
_SYN, _ACK, _RST_FIN = 0x02, 0x10, 0x05


class _Engine:
    """What the firewall needs of DUE, for one process."""

    def __init__(self) -> None:
        self.subjects: dict[str, Subject[Item]] = {}
        self.written: list[tuple[str, Any]] = []

    def observe(self, key: str) -> "Subject[Item]":
        return self.subjects.setdefault(key, Subject())

    active = True

    def get(self, _: Any, **__: Any) -> list[Item]:
        return []

    def flush(self, _: float) -> bool:
        return True

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
    """Blocks ("block") and guards ("protect") that the SYNs and SYN-ACKs of these packets lead to."""
    engine = _Engine()
    clock = _Clock()
    with mock.patch.object(service, "time", clock):
        due: Any = engine
        firewall = service.FirewallService(due, Settings())
        firewall.start()
        adapter = _Adapter(engine)
        for batch in batches:
            _live(firewall, clock, int(batch["time_us"][-1]) / 1e6)
            adapter.take(batch)
        _live(firewall, clock, clock.now + _GAP_S)
    return Counter(key.split(".")[1] for key, _ in engine.written if key.split(".")[1] in _DECISIONS)


class _Adapter:
    """Gives the firewall what it asks for: results of its queries, SYN-ACKs, and samples of SYNs."""

    def __init__(self, engine: _Engine) -> None:
        self._engine = engine
        self._queries = HostEngine()
        self._number = 0
        for key in list(engine.subjects):
            request = request_of(key, CATALOGUE) if key.startswith(QUERY_PREFIX) else None
            if request is not None:
                self._queries.add(msgspec.structs.replace(request.query, name=key))

    def take(self, batch: RecordBatch) -> None:
        """Packets in the order of time."""
        time_us = int(batch["time_us"][-1])
        for result in self._queries.process(batch):
            if isinstance(result, QueryResult):
                self._hand(result.query, result.query, result.to_value(), result.at_us)
        answers = (batch["tcp_flags"] & _ACK != 0) & (batch["tcp_flags"] & _SYN != 0)
        if answers.any():
            self._hand(_SYN_ACKS, _SYN_ACKS, batch.take(np.flatnonzero(answers)), time_us)
        syns = (batch["tcp_flags"] & _ACK == 0) & (batch["tcp_flags"] & _SYN != 0)
        for name, host in self._sampled().items():
            address = int(ip_address(host))
            mine = syns & (batch["ip_dst_lo"] == address & _LOW) & (batch["ip_dst_hi"] == address >> 64)
            if mine.any():
                part = batch.take(np.flatnonzero(mine))
                self._hand(f"{service.SAMPLES}.{name}", f"{_PACKETS}.{name}", part, time_us)

    def _sampled(self) -> dict[str, str]:
        """Name of each request for samples in force, and the host."""
        found: dict[str, str] = {}
        for key, value in self._engine.written:
            if key.startswith(f"{TELEMETRY}."):
                found.pop(value["name"], None)
                if value["active"]:
                    found[value["name"]] = str(value["conditions"]["dst"]).partition("/")[0]
        return found

    def _hand(self, subject: str, key: str, value: Any, time_us: int) -> None:
        self._number += 1
        app = "p4runtime_ctrl" if key.startswith(_PACKETS) else "sonata_adapter"
        item = Item(key, value, time_us * 1000, time_us * 1000, app, "innocent", self._number)
        self._engine.subjects[subject].on_next(item)


def _live(firewall: service.FirewallService, clock: _Clock, until: float) -> None:
    clock.now = max(clock.now, until - _GAP_S)
    while clock.now + _TICK_S < until:
        clock.now += _TICK_S
        firewall.tick()
    clock.now = max(clock.now, until)


def public_capture(table: Path) -> Iterator[RecordBatch]:
    """All TCP packets of the public capture."""
    for batch in read_batches(table):
        tcp = batch.take(np.flatnonzero((batch["tcp_dport"] >= 0) & (batch["quoted"] == 0)))
        yield from _pieces(RecordBatch({**tcp, "tcp_flags": np.full(len(tcp), _SYN, dtype=np.int32)}))


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
