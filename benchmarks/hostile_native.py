"""Our C under the address and undefined-behaviour sanitizers: Kitsune's kernel and the generated switch program.

A report of a sanitizer ends the process, which is a crash.  Only a process with the sanitizers' libraries can
load these builds (`hostile_sanitizers.environment`).
"""

import random
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from apps.kitsune.afterimage import WIDTH, AfterImage
from apps.kitsune.kernel import PACKET_FIELDS, ColumnError, load_kernel
from apps.kitsune.kitnet import KitNet
from apps.kitsune.service import packets_in
from apps.messages import MessageError
from benchmarks.hostile_messages import frames, packets
from benchmarks.hostile_mutation import mutate_bytes, mutate_protobuf, mutate_value
from benchmarks.hostile_sanitizers import kernel_library, sanitized_switches
from benchmarks.hostile_switch import TARGETS as SWITCH_TARGETS
from benchmarks.hostile_switch import AttackedDevice, stream_messages
from benchmarks.hostile_target import DecoderTarget
from dataplane.p4runtime.status import Refused
from dataplane.v1model.program import load
from dataplane.v1model.switch import Replica, Switch
from dataplane.v1model.tables import TableError
from due import Item
from due.codec import decode_value, encode_value
from due.errors import DecodeError as DueDecodeError
from sdnator.p4_program import find
from sdnator.testing import counting_traffic, hostile_traffic
from sdnator.testing.switch_traffic import Chooser

SANITIZED = True
_NOW = 1_700_000_000_000_000_000
_FRESH_EVERY = 500
"""Inputs after which tables are filled anew, and Kitsune's state begins anew: it may grow by design."""
_CPU = 510
_RECIPROCALS = (0, 1 << 32, (1 << 64) - 1, *map(hostile_traffic.reciprocal, (10, 1_000, 3_600_000_000)))


class _Kitsune:
    def __init__(self) -> None:
        self.kernel = load_kernel(kernel_library())
        self._inputs = 0

    def images(self) -> Sequence[AfterImage]:
        """Both modes; tables so small that cells are forgotten all the time."""
        if self._inputs % _FRESH_EVERY == 0:
            small = {"max_streams": 5, "max_links": 3}
            self._images = (
                AfterImage("bounded", kernel=self.kernel, horizon=0.1, **small),
                AfterImage("reference", kernel=self.kernel, horizon=3000.0),
            )
        self._inputs += 1
        return self._images

    def network(self) -> KitNet:
        """Trained anew now and then."""
        if self._inputs % _FRESH_EVERY == 0:
            self._network = KitNet(
                30, fm_grace=20, ad_grace=30, max_ae=4, clip=self._inputs % 2, kernel=self.kernel
            )
        self._inputs += 1
        return self._network


@cache
def _kitsune(_for: str) -> _Kitsune:
    return _Kitsune()


def _columns(data: bytes) -> None:
    """Bytes as the columns of a batch, whatever numbers that makes."""
    kinds = {"time_s" if name == "time" else name: np.dtype(kind) for name, _, kind in PACKET_FIELDS}
    rows = len(data) // sum(kind.itemsize for kind in kinds.values())
    batch, at = {}, 0
    for name, kind in kinds.items():
        batch[name] = np.frombuffer(data, kind, rows, at)
        at += rows * kind.itemsize
    for image in _kitsune("columns").images():
        assert image.update(batch).shape == (rows, WIDTH)


def _packets(data: bytes) -> None:
    """A value that the service takes, scored."""
    key = "network.packets.p4runtime_ctrl.s1.all"
    batch = packets_in(Item(key, decode_value(data), _NOW, _NOW, "p4runtime_ctrl", "i1", 1))
    for image in _kitsune("packets").images():
        with suppress(ColumnError):
            image.update(batch)


def _rows(data: bytes) -> None:
    network = _kitsune("rows").network()
    values = np.frombuffer(data, "f8", len(data) // 8)
    with np.errstate(all="ignore"):
        network.process(values[: values.size // 30 * 30].reshape(-1, 30))


def _column_bytes() -> tuple[bytes, ...]:
    batch = packets()
    whole = {**batch, "time_s": batch["time_us"] / 1e6}
    parts = ((name, kind) for name, _, kind in PACKET_FIELDS)
    return (
        b"".join(
            np.asarray(whole["time_s" if n == "time" else n]).astype(kind).tobytes() for n, kind in parts
        ),
    )


class _OwnSwitch:
    """The product's program, with entries as a controller gone wrong may send them."""

    def __init__(self) -> None:
        sanitized_switches()
        self._switch = Switch(load(find().bmv2_json.read_bytes()), cpu_port=_CPU)
        self._switch.set_ports([1, 2, 3])
        self._switch.set_clone_session(1, [Replica(_CPU, 1)])
        self._switch.set_multicast_group(1, [Replica(port, port) for port in (1, 2, 3)])
        self._inputs = 0

    def _fill(self) -> None:
        chooser = Chooser(self._inputs)
        for table in self._switch.tables.values():
            table.clear()
            for number in range(chooser.random.randint(0, 6) if table.spec.keys else 0):
                with suppress(TableError):  # equal to another, or an action that entries may not have
                    table.insert(chooser.entry(table.spec, number))
        for name, action, params in counting_traffic.defaults(chooser.random):
            self._switch.tables[name].set_default(action, params)
        for name, entry in hostile_traffic.entries(chooser.random, self._switch.tables, _RECIPROCALS):
            with suppress(TableError):
                self._switch.tables[name].insert(entry)
        for _ in range(20):
            array = self._switch.registers[chooser.random.choice(sorted(self._switch.registers))]
            array.write(
                chooser.random.randrange(min(array.size, 256)), chooser.random.getrandbits(array.width)
            )

    def attack(self, data: bytes) -> None:
        """A frame on every port, and the same bytes as a packet-out."""
        if self._inputs % (_FRESH_EVERY // 10) == 0:
            self._fill()
        self._inputs += 1
        whole = data[:65_535]
        for port in (1, 2):
            self._switch.process(port, whole, self._inputs * 1000)
        self._switch.packet_out(whole, self._inputs * 1000)
        assert not self._switch.out_of_range(), self._switch.out_of_range()


@cache
def _own_switch() -> _OwnSwitch:
    return _OwnSwitch()


@cache
def _device() -> AttackedDevice:
    sanitized_switches()
    return AttackedDevice()


def _attack_own(data: bytes) -> None:
    _own_switch().attack(data)


def _stream(data: bytes) -> None:
    _device().stream_message(data)


def _write(data: bytes) -> None:
    """A Write, then frames that meet its entries."""
    try:
        _device().write(data)
    finally:
        pipeline = _device().device.pipeline
        assert pipeline is not None
        pipeline.switch.process(1, data[:2000], 5)


def _packet_outs() -> tuple[bytes, ...]:
    """The header of a question about a cell, and frames."""
    heads = [bytes(range(n, n + 52)) for n in (0, 1, 64)]
    heads.append(b"\0\x83" + bytes(40) + b"\xff" * 10)
    return tuple(head + frame for head in heads for frame in frames(3))


def _seeds(name: str) -> tuple[bytes, ...]:
    return next(target.seeds for target in SWITCH_TARGETS if target.name == name)


def _extremes(chance: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Numbers that no double should be, among others."""
    data = bytearray(mutate_bytes(chance, seeds))
    for _ in range(chance.randint(0, 4)):
        at = chance.randrange(len(data) // 8 + 1) * 8
        data[at : at + 8] = np.float64(
            chance.choice((np.nan, np.inf, -np.inf, 1e308, -0.0, 5e-324))
        ).tobytes()
    return bytes(data)


_GENUINE_ROWS: Any = np.random.default_rng(1).normal(size=(70, 30))

TARGETS = (
    DecoderTarget("native kitsune columns", _columns, (ColumnError,), _column_bytes(), _extremes),
    DecoderTarget(
        "native kitsune packets",
        _packets,
        (MessageError, DueDecodeError),
        (encode_value(packets()),),
        mutate_value,
    ),
    DecoderTarget("native kitsune network", _rows, (ValueError,), (_GENUINE_ROWS.tobytes(),), _extremes),
    DecoderTarget("native switch program", _attack_own, (), (*frames(), *_packet_outs())),
    DecoderTarget(
        "native switch writes", _write, (DecodeError, Refused), _seeds("p4runtime write"), mutate_protobuf
    ),
    DecoderTarget(
        "native switch stream",
        _stream,
        (DecodeError, Refused),
        stream_messages(),
        mutate_protobuf,
    ),
)
