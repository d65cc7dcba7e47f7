"""Minutes of a soak run as the firewall hears them, to be played for hours.

    office traffic, at 4,000 packets a second ──► Detector, Handshakes, captures ──► Recording, in a process of its own
    Recording ──again and again, later each time, with other strangers──► messages

A network meets ever new addresses: those of the Internet are others in each turn.  What is recorded is what comes
when training has long been over.
"""

import re
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from apps.evidence import EVIDENCE, TrainingState
from apps.sonata_adapter.host.handshake import Handshakes
from apps.sonata_adapter.keys import HANDSHAKE
from benchmarks.decision_traffic.networks import NETWORKS
from benchmarks.decisions_core import SWITCH, detector_for
from benchmarks.soak_state_stage import START_NS
from due import RecordBatch
from due.codec import decode_value, encode_value

PPS: Final = 4_000
TRAINING: Final = 55_000
SYN_ACKS: Final = "network.traffic_capture.sonata.tcp:flag=syn+ack"
ARPS: Final = "network.traffic_capture.sonata.arp"
ALERTS: Final = "network.anomaly.kitsune.alert"
_ROWS: Final = 4_096
_PIECE: Final = 256
_MORNING_S: Final = 9 * 3600
_END_S: Final = 365 * 86_400
_SETTLED: Final = 3
"""One part in so many from the begin is left out."""
_ADDRESS: Final = re.compile(rb"\b(\d{1,3})\.(\d{1,3})\.(\d{1,3})\.(\d{1,3})\b")
_AT_HOME: Final = (0, 10, 127, 169, 172, 192, 198)
_MULTICAST: Final = 224
_TURN: Final = 7_919 * 257
_HEAD: Final = struct.Struct("!I")


class Recorded(NamedTuple):
    """One message."""

    at_us: int
    """Since the begin of the recording."""
    key: str
    app: str
    text: bytes
    """JSON; empty: it is columns."""
    columns: bytes
    """An encoded record batch."""


class Recording(NamedTuple):
    """Messages in order of time, and what was said of training."""

    seconds: float
    training: dict[str, Any]
    messages: list[Recorded]


def recorded(packets: int) -> Recording:
    """Record so many packets, two thirds of them, in another process: its memory is not to be counted."""
    with tempfile.TemporaryDirectory(prefix="soak-state-") as folder:
        file = Path(folder) / "recording"
        subprocess.run(
            [sys.executable, "-m", "benchmarks.soak_state_recording", str(packets), str(file)], check=True
        )
        return msgspec.msgpack.decode(file.read_bytes(), type=Recording)


def office(packets: int) -> Iterator[RecordBatch]:
    """Batches of `traffic`, made in another process."""
    command = [sys.executable, "-m", "benchmarks.soak_state_recording", str(packets)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            while head := process.stdout.read(_HEAD.size):
                yield decode_value(process.stdout.read(*_HEAD.unpack(head)))
        finally:
            process.kill()


def traffic(packets: int) -> Iterator[RecordBatch]:
    """Batches of office traffic with time stamps of `PPS` from `START_NS` on."""
    fed = 0
    for part in NETWORKS["office"](1).chunks(_MORNING_S, _END_S):
        columns = dict(part.columns)
        numbers = fed + np.arange(len(part))
        columns["time_us"] = (START_NS // 1000 + numbers * 1_000_000 // PPS).astype(columns["time_us"].dtype)
        columns["arrival"] = (numbers + 1).astype(columns["arrival"].dtype)
        for start in range(0, min(len(part), packets - fed), _ROWS):
            yield RecordBatch({name: column[start : start + _ROWS] for name, column in columns.items()})
        fed += len(part)
        if fed >= packets:
            return


def _record(packets: int) -> Recording:
    detector, shakes = detector_for(TRAINING), Handshakes()
    begin_us = START_NS // 1000 + packets // _SETTLED * 1_000_000 // PPS
    found: list[Recorded] = []
    for batch in traffic(packets):
        _, alerts = detector.process(batch, SWITCH)
        heard = detector.take_evidence()
        completed = shakes.process(batch)
        if int(batch["time_us"][0]) < begin_us:
            continue
        found += [
            _plain(ALERTS, "kitsune", each.to_value(), each.event_time // 1000 - begin_us) for each in alerts
        ]
        found += [
            _plain(
                f"{EVIDENCE}.kitsune.{each.source}",
                "kitsune",
                each.to_value(),
                each.event_time // 1000 - begin_us,
            )
            for each in heard
        ]
        found += [
            _plain(HANDSHAKE, "sonata_adapter", each.to_value(), each.at_us - begin_us) for each in completed
        ]
        found += _captured(batch, SYN_ACKS, batch["tcp_flags"] & 0x12 == 0x12, begin_us)
        found += _captured(batch, ARPS, batch["arp_op"] >= 0, begin_us)
    found.sort(key=lambda each: each.at_us)
    state = TrainingState(
        packets=TRAINING,
        wanted=TRAINING,
        done=True,
        seconds=detector.behaviour.seconds,
        senders=len(detector.behaviour.senders),
        hosts=len(detector.behaviour.senders),
        event_time=START_NS,
    )
    return Recording((packets - packets // _SETTLED) / PPS, state.to_value(), found)


def _plain(key: str, app: str, value: Any, at_us: int) -> Recorded:
    return Recorded(max(0, at_us), key, app, msgspec.json.encode(value), b"")


def _captured(batch: RecordBatch, key: str, chosen: Any, begin_us: int) -> Iterator[Recorded]:
    rows = np.flatnonzero(chosen)
    for start in range(0, len(rows), _PIECE):
        some = batch.take(rows[start : start + _PIECE])
        at_us = int(some["time_us"][-1]) - begin_us
        shifted = {name: some[name] - begin_us if name == "time_us" else some[name] for name in some.columns}
        yield Recorded(max(0, at_us), key, "sonata_adapter", b"", encode_value(RecordBatch(shifted)))


def played(one: Recorded, turn: int, begin_us: int, number: int) -> bytes:
    """The encoded value of a message in a turn.

    Args:
        one: as it was recorded.
        turn: 0: the first.
        begin_us: absolute time of the turn's begin.
        number: of all messages, for ids.
    """
    if one.columns:
        batch = decode_value(one.columns)
        return encode_value(
            RecordBatch(
                {name: batch[name] + begin_us if name == "time_us" else batch[name] for name in batch.columns}
            )
        )
    value = msgspec.json.decode(_ADDRESS.sub(lambda found: _other(found, turn), one.text))
    later_ns = (begin_us + one.at_us) * 1000
    before_ns = later_ns - value.get("event_time", value.get("at", 0))
    for name in ("event_time", "since", "at"):
        if name in value:
            value[name] += before_ns
    if "id" in value:
        value["id"] = f"{value['id'][:200]}-{number}"
    if "number" in value:
        value["number"] = 0
    return encode_value(value)


def _other(found: "re.Match[bytes]", turn: int) -> bytes:
    """A stranger's address in this turn."""
    first, *rest = map(int, found.groups())
    if not turn or first in _AT_HOME or first >= _MULTICAST:
        return found.group()
    low = ((rest[0] << 16 | rest[1] << 8 | rest[2]) + turn * _TURN) & 0xFF_FFFF
    return b"%d.%d.%d.%d" % (first, low >> 16, low >> 8 & 0xFF, low & 0xFF)


def _main(packets: int, *file: str) -> None:
    """Write a recording to a file, or the traffic itself to standard output."""
    if file:
        Path(file[0]).write_bytes(msgspec.msgpack.encode(_record(packets)))
        return
    for batch in traffic(packets):
        payload = encode_value(batch)
        sys.stdout.buffer.write(_HEAD.pack(len(payload)) + payload)


if __name__ == "__main__":
    _main(int(sys.argv[1]), *sys.argv[2:])
